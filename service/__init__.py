"""The product on the cell PC: streams both fingers, detects incipient slip, decides the correction."""

__version__ = "0.1.0"
