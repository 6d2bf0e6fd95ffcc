"""Training runs: the loop, its stages, and the checkpoint that they end in."""
