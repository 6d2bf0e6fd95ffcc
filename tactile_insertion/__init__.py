"""One command for all rooms: `tactile-insertion COMMAND`; see `tactile_insertion.commands` for the table."""
