"""Command line of the simulator, one module per command."""
