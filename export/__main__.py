"""``python -m export COMMAND``."""

import sys

from export.cli.commands import main

if __name__ == "__main__":
    sys.exit(main())
