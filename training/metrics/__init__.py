"""How good predictions are, and their calibration."""
