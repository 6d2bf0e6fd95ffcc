"""The networks by kind. To add one, add a file here and a line in NETWORKS."""

from typing import Any, Literal

from service.contract import ContractError, Sensor
from service.contract.refusals import nearest
from training.networks.alexnet import AlexNetPair
from training.networks.compact import CompactNetwork
from training.networks.decider import Decider
from training.networks.markers import MarkerNetwork
from training.networks.pressing import PressingNetwork
from training.networks.settings import NetworkConfig

NETWORKS: dict[str, type[Decider | AlexNetPair]] = {
    "alexnet_lstm": AlexNetPair,
    "compact": CompactNetwork,
    "markers": MarkerNetwork,
    "pressing": PressingNetwork,
}


def network_class(kind: str) -> type[Decider | AlexNetPair]:
    """The class of a kind; raises ContractError on an unknown one, naming the nearest."""
    if kind not in NETWORKS:
        raise ContractError(f"network.kind: {kind!r} is unknown{nearest(kind, NETWORKS)}")
    return NETWORKS[kind]


def reads(kind: str) -> Literal["pictures", "markers", "steps"]:
    """The input of a kind of network: frames, markers tracked in them, or steps of depth."""
    network = network_class(kind)
    if network.reads_steps:
        return "steps"
    return "markers" if network.reads_markers else "pictures"


def build(settings: NetworkConfig, classes: int, sensor: Sensor) -> Any:
    """A new network of the configured kind: a Decider, or the paper's pair; ContractError on an unknown kind."""
    return network_class(settings.kind)(settings, classes, sensor)
