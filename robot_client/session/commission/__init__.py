"""The first day of a cell."""
