"""``python -m robot_client COMMAND``; see ``--help``."""

import sys

from robot_client.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
