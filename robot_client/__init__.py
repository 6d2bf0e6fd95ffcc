"""Drives the ABB arm and the WSG-50 gripper through one insertion. Not a safety function."""
