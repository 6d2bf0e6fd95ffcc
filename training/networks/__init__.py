"""The networks, by name."""

from training.config import NetworkConfig
from training.networks.alexnet import AlexNetPair
from training.networks.compact import CompactNetwork


def build(settings: NetworkConfig, classes: int) -> CompactNetwork:
    """A fresh compact network; `train` knows no other kind."""
    return CompactNetwork(settings, classes)


def build_any(settings: NetworkConfig, classes: int) -> CompactNetwork | AlexNetPair:
    """A fresh network of the configured kind."""
    return AlexNetPair(classes) if settings.kind == "alexnet_lstm" else CompactNetwork(settings, classes)
