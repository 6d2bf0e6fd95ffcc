"""Versions of the networks: one decides, others run in shadow, and the better one takes over between insertions."""
