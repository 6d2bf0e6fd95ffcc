"""The networks, by name."""

from training.config import NetworkConfig
from training.networks.alexnet import AlexNetPair
from training.networks.compact import CompactNetwork
from training.networks.decider import Decider
from training.networks.markers import MarkerNetwork


def build(settings: NetworkConfig, classes: int) -> Decider:
    """A fresh network of ours: the compact one, which reads pictures, or the one that reads markers."""
    return MarkerNetwork(settings, classes) if settings.kind == "markers" else CompactNetwork(settings, classes)


def build_any(settings: NetworkConfig, classes: int) -> Decider | AlexNetPair:
    """A fresh network of the configured kind."""
    return AlexNetPair(classes) if settings.kind == "alexnet_lstm" else build(settings, classes)
