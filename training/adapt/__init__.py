"""A released network becomes one of a cell: fitted in stages, accepted only where held-out fixtures show it better."""
