"""Recorded insertions: written, read, recovered and kept within a bound."""
