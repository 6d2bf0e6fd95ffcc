"""Adapts a released network to one cell: fitted in stages, accepted only if better on held-out fixtures."""
