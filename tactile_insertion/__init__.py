"""One command for all packages: `tactile-insertion COMMAND`; see `tactile_insertion.commands` for the table."""
