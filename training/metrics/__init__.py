"""Figures of predictions, and their calibration."""
