"""Accuracy against time: networks, slip trackers and physics settings."""
