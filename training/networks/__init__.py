"""The networks, by name."""

from service.contract import Sensor
from training.config import NetworkConfig
from training.networks.alexnet import AlexNetPair
from training.networks.compact import CompactNetwork
from training.networks.decider import Decider
from training.networks.markers import MarkerNetwork


def build(settings: NetworkConfig, classes: int, sensor: Sensor) -> Decider:
    """A fresh network of ours: the compact one, which reads pictures, or the one that reads markers."""
    kind = MarkerNetwork if settings.kind == "markers" else CompactNetwork
    return kind(settings, classes, sensor)


def build_any(settings: NetworkConfig, classes: int, sensor: Sensor) -> Decider | AlexNetPair:
    """A fresh network of the configured kind; the paper's own resizes any frame."""
    return AlexNetPair(classes) if settings.kind == "alexnet_lstm" else build(settings, classes, sensor)
