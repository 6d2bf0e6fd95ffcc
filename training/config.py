"""One run of training, read from one TOML file, which holds every value that shapes a network."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, Self

from pydantic import Field, JsonValue, ValidationError

from service.contract.frames import Contract, ContractError
from service.contract.refusals import describe
from service.contract.toml import read_toml
from service.durable import locked, write_durably
from training.networks import network_class
from training.networks.settings import FRAMES_PER_DECISION, NetworkConfig

JITTER = 1
WINDOW = FRAMES_PER_DECISION + 2 * JITTER
"""Frames kept per trial: one more on either side of the decision's eight, for onset jitter."""


class DataConfig(Contract):
    """Which trials are read. ``rendered`` limits the training trials drawn as images (the costly part).

    ``views``: cameras drawn for each training trial that is read as steps of depth.
    """

    path: str
    cache: str = "runs/cache"
    max_trials: int = Field(default=1_000_000, ge=1)
    rendered_training: int = Field(default=1200, ge=0)
    rendered_validation: int = Field(default=400, ge=0)
    rendered_test: int = Field(default=400, ge=0)
    views: int = Field(default=2, ge=1)


class StageConfig(Contract):
    """One stage of training: AdamW, warm-up and cosine, early stopping after ``patience`` epochs without gain."""

    epochs: int = Field(ge=0)
    batch: int = Field(default=64, ge=1)
    learning_rate: float = Field(default=1e-3, gt=0)
    weight_decay: float = Field(default=1e-2, ge=0)
    patience: int = Field(default=6, ge=1)
    max_minutes: float = Field(default=60.0, gt=0)


class LossConfig(Contract):
    """Weights of the losses beside the cross entropy of the class."""

    magnitude: float = Field(default=0.5, ge=0)
    density: float = Field(default=0.5, ge=0)
    field: float = Field(default=0.5, ge=0)


class AnyRun(Contract):
    """Fields of every run: its name, its output folder, and the device that computes its steps."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")
    seed: int = Field(default=0, ge=0, lt=2**32)
    threads: int = Field(default=1, ge=1, le=256)
    device: str = Field(default="cpu", pattern=r"^(cpu|cuda)$")
    runs: str = "runs"

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file; raise ContractError naming the file, the wrong key, and the nearest allowed one."""
        try:
            return cls.model_validate(read_toml(path))
        except OSError as error:
            raise ContractError(f"cannot read the run config {path}: {error.strerror}") from error
        except ValidationError as error:
            raise ContractError(f"{path}: {describe(error, cls)}") from error

    @property
    def folder(self) -> Path:
        return Path(self.runs) / self.name


class RunConfig(AnyRun):
    """A whole run: images to marker motion (front), marker motion to decision (trunk), both together (tune).

    ``start_from``: a checkpoint with the initial weights, instead of random ones.
    """

    start_from: str | None = None
    data: DataConfig
    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig()
    front: StageConfig = StageConfig(epochs=0)
    trunk: StageConfig
    tune: StageConfig = StageConfig(epochs=0)

    @classmethod
    def load(cls, path: Path) -> Self:
        """As for every run; an unknown kind of network is refused with the nearest known one."""
        config = super().load(path)
        try:
            network = network_class(config.network.kind)
            if network.reads_steps and not config.network.affine_fit:
                raise ContractError("network.affine_fit is false, networks that read steps of depth need it")
            if config.front.epochs + config.tune.epochs and (network.reads_markers or network.reads_steps):
                raise ContractError(f"[front] and [tune] train on pictures, which {config.network.kind} does not read")
        except ContractError as error:
            raise ContractError(f"{path}: {error}") from error
        return config

    def settings(self) -> dict[str, JsonValue]:
        """All settings that shaped the network, for its card: no paths of this machine; a start is named by its run."""
        stated: dict[str, JsonValue] = self.model_dump(mode="json", exclude={"runs": True, "data": {"path", "cache"}})
        return stated | {"start_from": Path(self.start_from).parent.name if self.start_from else None}


class RecipeConfig(AnyRun):
    """One run of the recipe. Trials are those of each split, up to a maximum, chosen by the hash of their content."""

    data: str
    cache: str = "runs/cache"
    imagenet: str | None = None
    pretraining_trials: int = Field(default=500, ge=1)
    training_trials: int = Field(default=30_000, ge=1)
    validation_trials: int = Field(default=2000, ge=1)
    test_trials: int = Field(default=2000, ge=1)
    convolutions: StageConfig
    direction: StageConfig
    magnitude: StageConfig

    def settings(self) -> dict[str, JsonValue]:
        """All settings that shaped the networks, for their card; paths of this machine are omitted."""
        stated: dict[str, JsonValue] = self.model_dump(mode="json", exclude={"runs", "data", "cache", "imagenet"})
        return stated | {"imagenet": self.imagenet is not None}


def alone_in(folder: Path) -> BinaryIO:
    """Keep other runs out of ``folder`` until the result is closed; raise ContractError if one is in it."""
    try:
        return locked(folder)
    except BlockingIOError as error:
        raise ContractError(f"{folder}: another process is training there; expected another name") from error


def refuse_another(folder: Path, config: Contract) -> None:
    """Raise ContractError if a run with another config wrote into ``folder``: it cannot be resumed.

    `max_minutes` may differ: it shapes no step, and a stage that it cut goes on with more of them.
    """
    path = folder / "config.json"
    if not path.exists():
        return
    try:
        apart = list(differences(_shaping(path.read_bytes()), _shaping(config.model_dump_json())))
    except (ValueError, AttributeError):
        apart = ["its config.json is damaged"]
    if apart:
        what = "; ".join(["belongs to a run with another config", *apart])
        raise ContractError(f"{folder} {what}; expected a new name or an empty folder")


def _shaping(config: str | bytes) -> dict[str, Any]:
    """The settings that shape a network's training."""
    read = json.loads(config, object_hook=lambda part: {key: part[key] for key in part if key != "max_minutes"})
    return dict(read.items())


def differences(one: Mapping[str, Any], other: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """Each setting in which two configs differ, by its dotted key."""
    for name in sorted({*one, *other}):
        was, asked = one.get(name), other.get(name)
        if isinstance(was, dict) and isinstance(asked, dict):
            yield from differences(was, asked, f"{above}{name}.")
        elif was != asked:
            yield f"its {above}{name} is {was}, not {asked}"


def refuse_other_grounds(folder: Path, grounds: str) -> None:
    """Raise ContractError if the contents of ``folder`` were learnt from other data: ``grounds`` are its hashes."""
    path = folder / "learnt_from.txt"
    if path.exists() and path.read_text() != grounds:
        what = "was trained on other data or from other weights"
        raise ContractError(f"{folder} {what}; expected the same, a new name or an empty folder")


def pin(folder: Path, config: Contract, grounds: str) -> None:
    """Claim ``folder`` for the run with this config and these grounds, which are stored next to its weights."""
    refuse_another(folder, config)
    refuse_other_grounds(folder, grounds)
    write_durably(folder / "config.json", config.model_dump_json(indent=1))
    write_durably(folder / "learnt_from.txt", grounds)
