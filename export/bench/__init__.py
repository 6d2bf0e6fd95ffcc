"""The cost of a decision on this machine."""
