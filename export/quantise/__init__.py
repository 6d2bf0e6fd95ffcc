"""Smaller weights: int8 builds of a released network."""
