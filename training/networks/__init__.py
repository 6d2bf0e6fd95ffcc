"""The networks, by name."""

from training.config import NetworkConfig
from training.networks.compact import CompactNetwork


def build(settings: NetworkConfig, classes: int) -> CompactNetwork:
    """A fresh network of the configured kind."""
    return CompactNetwork(settings, classes)
