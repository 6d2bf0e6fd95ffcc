"""`python -m tactile_insertion COMMAND`, the same as `tactile-insertion COMMAND`."""

import sys

from tactile_insertion.command_line import main

if __name__ == "__main__":
    sys.exit(main())
