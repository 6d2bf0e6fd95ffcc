"""Versions of the networks: one decides, others run beside it, and the better one takes over between insertions."""
