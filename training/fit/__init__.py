"""Training runs: the loop, its stages, and the resulting checkpoint."""
