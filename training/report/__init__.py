"""The training report of a finished run, with its stress and oracle rows."""
