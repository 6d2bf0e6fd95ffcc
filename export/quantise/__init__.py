"""Smaller weights: int8 and fp16 builds of a released network."""
