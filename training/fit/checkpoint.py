"""A trained network on disk: weights, sizes, and everything for its model card."""

import hashlib
import io
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from pydantic import JsonValue, ValidationError
from torch import Tensor

from service.contract import ContractError, Sensor
from service.contract.frames import first_error
from service.contract.model_card import Expectations, Pressing
from service.durable import write_durably
from training.config import differences
from training.data.labels import CLASSES
from training.metrics.figures import Scales
from training.networks import build
from training.networks.settings import NetworkConfig

_FORMAT = 1
OWN, AS_TRAINED = "validation/all", "trained/all"
"""Keys of a network's figures: its own, and those of the release that it was adapted from."""


def save_whole(path: Path, contents: dict[str, Any]) -> None:
    """Write a file of torch durably; raises ContractError on a full disk."""
    whole = io.BytesIO()
    torch.save(contents, whole)
    try:
        write_durably(path, whole.getvalue())
    except OSError as error:
        raise ContractError(f"{path} cannot be written, is the disk full? {error}") from error


@dataclass(frozen=True)
class Checkpoint:
    """Everything that the exporter needs. ``figures`` belong to the split and the objects that their key names."""

    name: str
    network: NetworkConfig
    weights: dict[str, Tensor]
    scales: Scales
    joint_scales: Scales
    figures: dict[str, dict[str, float]]
    training_data_sha256: str
    git_commit: str
    run: dict[str, JsonValue] = field(default_factory=dict)
    """Settings of its training run."""
    sensor: Sensor = field(default_factory=Sensor.load)
    pressing: Pressing | None = None
    """For networks that read steps of depth: how they read them."""
    expectations: Expectations = field(default_factory=Expectations)
    """Expectations of attempts with it, for the belief."""

    @property
    def as_trained(self) -> dict[str, float]:
        """Figures of the training that this network is from, adapted since or not; empty if it was not validated."""
        return self.figures.get(AS_TRAINED, self.figures.get(OWN, {}))

    def save(self, path: Path) -> None:
        about = {
            "format": _FORMAT,
            "name": self.name,
            "network": self.network.model_dump(),
            "scales": asdict(self.scales),
            "joint_scales": asdict(self.joint_scales),
            "figures": self.figures,
            "training_data_sha256": self.training_data_sha256,
            "git_commit": self.git_commit,
            "run": self.run,
            "sensor": self.sensor.model_dump(),
            "pressing": self.pressing.model_dump() if self.pressing else None,
            "expectations": self.expectations.model_dump(mode="json"),
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        save_whole(path, {"about": json.dumps(about), "weights": self.weights})

    @classmethod
    def load(cls, path: Path) -> "Checkpoint":
        """Read back; raise ContractError on a file that is absent, damaged or of another version."""
        try:
            stored: dict[str, Any] = torch.load(path, weights_only=True, map_location="cpu")
            about = json.loads(stored["about"])
            if about.pop("format") != _FORMAT:
                raise ContractError(f"checkpoint {path} has another format, expected {_FORMAT}")
            about["network"] = NetworkConfig.model_validate(about["network"])
            about["sensor"] = Sensor.model_validate(about["sensor"])
            if about.get("pressing"):
                about["pressing"] = Pressing.model_validate(about["pressing"])
            about["expectations"] = Expectations.model_validate_json(json.dumps(about["expectations"]))
            for name in ("scales", "joint_scales"):
                about[name] = Scales(**about[name])
            return cls(weights=stored["weights"], **about)
        except ContractError:
            raise
        except OSError as error:
            raise ContractError(f"cannot read the checkpoint {path}: {error.strerror}") from error
        except ValidationError as error:
            raise ContractError(f"checkpoint {path}: {first_error(error)}") from error
        except Exception as error:  # torch raises pickle, zip and key errors of many kinds on a damaged file
            raise ContractError(f"checkpoint {path} is damaged or not one of ours: {type(error).__name__}") from error

    def known_from(self, path: Path) -> "Checkpoint":
        """With the commit and the measured creep of the one at ``path``, if that is the same network; ContractError."""
        if not path.exists():
            return self
        before = Checkpoint.load(path)
        if before.weights_sha256() != self.weights_sha256():
            return self
        return replace(self, git_commit=before.git_commit, expectations=before.expectations)

    def weights_sha256(self) -> str:
        """Hash of the weights alone: it does not change with the figures or the commit."""
        digest = hashlib.sha256()
        for name in sorted(self.weights):
            digest.update(name.encode() + self.weights[name].numpy().tobytes())
        return digest.hexdigest()

    def build(self, expected: NetworkConfig | None = None) -> Any:
        """The network with its weights, in evaluation mode; raise ContractError if they do not fit ``expected``."""
        expected = expected or self.network
        network = build(expected, len(CLASSES), self.sensor)
        try:
            network.load_state_dict(self.weights)
        except RuntimeError as error:
            apart = differences(self.network.model_dump(), expected.model_dump())
            what = "; ".join([f"holds another architecture than {expected.kind}", *apart])
            raise ContractError(f"checkpoint {self.name} {what}") from error
        return network.eval()
