"""Command line of the simulator, one module a command."""
