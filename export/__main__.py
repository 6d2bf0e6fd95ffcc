"""``python -m export COMMAND``."""

from export.cli.commands import main

if __name__ == "__main__":
    main()
