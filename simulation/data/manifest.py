"""The manifest of a dataset."""

import hashlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from service.contract.frames import Contract, ContractError
from service.contract.refusals import reason
from service.contract.sensor import Sensor

MANIFEST = "manifest.json"
SCHEMA_VERSION: Final = 2  # 1 did not state how high the object is held


class DatasetError(ContractError):
    """A dataset, shard or label that cannot be used; the text names it and the expected value."""


@contextmanager
def naming(path: Path, trial: int) -> Iterator[None]:
    """Read one trial of a file: whatever is wrong with it becomes a DatasetError that names both."""
    try:
        yield
    except KeyError as error:
        raise DatasetError(f"{path}: trial {trial} lacks {error}") from error
    except (ValueError, TypeError, OSError) as error:  # pyarrow's errors are among them
        why = reason(error).partition("\n")[0]
        raise DatasetError(f"{path}: trial {trial} cannot be read: {why}") from error


class ShardEntry(Contract):
    """One complete shard on disk. ``outcomes`` counts all pokes it took, kept ("blocked") or not."""

    name: str
    object_name: str
    trials: int = Field(ge=0)
    size_bytes: int = Field(ge=0)
    sha256: str
    outcomes: dict[str, int] = Field(default_factory=dict)

    @property
    def order(self) -> tuple[str, str]:
        """Shards are sorted by number first: objects stay mixed, and a larger collection starts with the smaller."""
        return self.name.rpartition("-")[2], self.name

    @classmethod
    def of(cls, name: str, data: bytes, *, trials: int, object_name: str, outcomes: dict[str, int]) -> Self:
        """The entry of a shard whose bytes are ``data``."""
        digest, size = hashlib.sha256(data).hexdigest(), len(data)
        return cls(name=name, object_name=object_name, trials=trials, size_bytes=size, sha256=digest, outcomes=outcomes)

    def must_be_whole(self, folder: Path, *, verify: bool = False) -> None:
        """DatasetError if the file is missing, has another size or, with ``verify``, other contents."""
        path = folder / self.name
        if not path.is_file():
            raise DatasetError(f"{path}: listed in {MANIFEST} but missing")
        if path.stat().st_size != self.size_bytes:
            raise DatasetError(f"{path}: {path.stat().st_size} bytes, {MANIFEST} says {self.size_bytes} (truncated?)")
        if verify and file_sha256(path) != self.sha256:
            raise DatasetError(f"{path}: SHA-256 differs from {MANIFEST} (altered since it was written)")


class Manifest(Contract):
    """What a dataset holds and how it was made.

    ``scenes``: name -> SHA-256 of the base scene. ``physics``: hash of the collecting code, "" in datasets older than
    the field. ``sensor``: the fingers' profile.
    """

    schema_version: Literal[2] = SCHEMA_VERSION
    made_by: str
    seed: int
    trials_per_object: int = Field(ge=1)
    trials_per_shard: int = Field(ge=1)
    held_out_share: float = Field(ge=0, le=1)
    scenes: dict[str, str]
    sensor: Sensor = Field(default_factory=Sensor.load)
    physics: str = ""
    complete: bool = False
    shards: tuple[ShardEntry, ...] = ()

    @model_validator(mode="after")
    def _no_shard_twice(self) -> Self:
        if twice := [name for name, count in Counter(entry.name for entry in self.shards).items() if count > 1]:
            raise ValueError(f"shard {twice[0]} is listed twice")
        return self

    @property
    def trials(self) -> int:
        """Number of trials in all listed shards."""
        return sum(entry.trials for entry in self.shards)

    def missing_shards(self) -> list[tuple[str, int]]:
        """(scene name, shard number) of each shard missing from the requested size, objects interleaved."""
        listed = {entry.name for entry in self.shards}
        numbers = range(-(-self.trials_per_object // self.trials_per_shard))
        return [(scene, n) for n in numbers for scene in self.scenes if shard_file_name(scene, n) not in listed]

    def sha256(self) -> str:
        """One digest of all contents, used by model cards to identify their training data."""
        listed = "\n".join(f"{entry.name} {entry.sha256}" for entry in self.shards)
        return hashlib.sha256(listed.encode()).hexdigest()

    def must_continue(self, fresh: "Manifest", path: Path) -> None:
        """DatasetError unless ``fresh`` requests more of the same collection."""
        for name in ("schema_version", "made_by", "seed", "trials_per_shard", "held_out_share", "sensor"):
            mine, asked = getattr(self, name), getattr(fresh, name)
            if mine != asked:
                raise DatasetError(f"{path / MANIFEST}: {name} is {mine}, asked for {asked}; use another folder")
        for name in self.scenes.keys() & fresh.scenes.keys():
            if self.scenes[name] != fresh.scenes[name]:
                raise DatasetError(f"{path / MANIFEST}: scene {name} has changed since; use another folder")


def shard_file_name(scene_name: str, number: int) -> str:
    """File name of shard ``number`` of a scene (name or TOML path)."""
    return f"{Path(scene_name).stem}-{number:05d}.parquet"


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a dataset folder; DatasetError names what is wrong with it."""
    path = folder / MANIFEST
    try:
        return Manifest.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: no such file; a dataset is a folder with {MANIFEST} and shards") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if key == "schema_version":
            raise DatasetError(f"{path}: schema version {first['input']!r}, expected {SCHEMA_VERSION}") from error
        raise DatasetError(f"{path}: {key or 'contents'}: {first['msg'].removeprefix('Value error, ')}") from error


def file_sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
