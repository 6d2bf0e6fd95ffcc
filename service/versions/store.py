"""Versions on disk: one folder each, named by its contents, and one file that assigns their roles.

``STATE/versions/<version>/*.onnx`` and ``STATE/versions/wiring.json``. Every change is one rename of a file already on
the disk, so that a kill or a power cut leaves either the old or the new wiring.
"""

import hashlib
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Literal, Self

from pydantic import Field, ValidationError

from service.contract.frames import Contract, ContractError, Finger, first_error
from service.decision.models import ModelSet, load_models
from service.durable import locked, sync_folder, write_durably
from service.versions.contest import Contest, Role

WIRING, LOCK = "wiring.json", "lock"


class Wiring(Contract):
    """Which version decides, which run beside it, and the evidence for those.

    ``released``: the version in the service's models folder, the origin of all others. ``rejected``: why, by version,
    the latest last: its files stay, so that its recordings can be decided again. ``given``: the shadow that the
    settings gave last; what a person has changed since stays changed. ``gels``: those with which a version took over.
    """

    schema_version: Literal[1] = 1
    released: str
    active: str
    beside: dict[Role, str] = Field(default_factory=dict)
    contests: dict[Role, Contest] = Field(default_factory=dict)
    rejected: dict[str, str] = Field(default_factory=dict)
    given: str = ""
    gels: dict[str, dict[Finger, str]] = Field(default_factory=dict)
    sha256: str = ""

    def contest(self, role: Role) -> Contest:
        """The evidence for the version in a role; empty without one."""
        return self.contests.get(role, Contest())

    def with_one(self, role: Role, version: str, contest: Contest) -> Self:
        """The same with a version in a role."""
        wired = {"beside": self.beside | {role: version}, "contests": self.contests | {role: contest}}
        return self.model_copy(update=wired)

    def without(self, role: Role) -> Self:
        """The same with nothing in a role."""
        beside = {one: version for one, version in self.beside.items() if one != role}
        contests = {one: contest for one, contest in self.contests.items() if one != role}
        return self.model_copy(update={"beside": beside, "contests": contests})

    def digest(self, *, as_read: bool = False) -> str:
        """SHA-256 of all fields but itself, or of those that were in the file: an older one has fewer."""
        return hashlib.sha256(self.model_dump_json(exclude={"sha256"}, exclude_unset=as_read).encode()).hexdigest()


def version_of(models: ModelSet) -> str:
    """The name of a version, from the SHA-256 of all its files."""
    return _name(model.sha256 for model in models.models)


def check_served(released: ModelSet) -> None:
    """Raise ContractError where a restart would begin anew with other networks, which nothing has judged."""
    if not _holds(released.folder, version_of(released)):
        raise ContractError(
            f"{released.folder} no longer holds the networks that this service was started with, and the next start"
            " would let what is there decide: put them back, and export the new ones to another folder"
        )


def _holds(folder: Path, version: str) -> bool:
    """Whether a folder has the files of a version, and no other networks."""
    files = (path.read_bytes() for path in folder.glob("*.onnx"))
    return _name(hashlib.sha256(content).hexdigest() for content in files) == version


def _name(hashes: Iterable[str]) -> str:
    return hashlib.sha256("".join(sorted(hashes)).encode()).hexdigest()[:16]


class Store:
    """The versions of one service. Raises ContractError if another service keeps its own there, OSError as usual."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self._lock: IO[bytes] | None = None

    def open(self) -> Wiring | None:
        """The wiring, None if there is none yet. Raises ContractError if it was edited."""
        path = self.home / WIRING
        if not path.exists():
            return None
        self._own()
        try:
            wiring = Wiring.model_validate_json(path.read_bytes())
        except ValidationError as error:
            raise ContractError(
                f"{path} says of no versions: {first_error(error)}; remove it to begin anew with the released networks"
            ) from None
        if wiring.sha256 != wiring.digest(as_read=True):
            raise ContractError(f"{path} is not as it was written; remove it to begin anew with the released networks")
        return wiring

    def close(self) -> None:
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def load(self, version: str) -> ModelSet:
        """A stored version; raises ContractError if it cannot serve or has changed."""
        models = load_models(self.home / version)
        if version_of(models) != version:
            raise ContractError(f"{self.home / version} does not hold version {version} any more")
        return models

    def keep(self, models: ModelSet) -> str:
        """Copy a version; returns its name. Raises OSError if there is no room, ContractError if it has changed."""
        version = version_of(models)
        self._own()
        if _holds(self.home / version, version):
            return version
        fresh = self.home / f".{version}"
        for left in (fresh, self.home / version):  # a kill may have interrupted its writing or removal
            shutil.rmtree(left, ignore_errors=True)
        fresh.mkdir()
        for model in models.models:
            content = model.path.read_bytes()
            if hashlib.sha256(content).hexdigest() != model.sha256:
                raise ContractError(f"{model.path} has changed while it was read; give its folder again")
            write_durably(fresh / model.path.name, content)
        fresh.rename(self.home / version)
        sync_folder(self.home)
        return version

    def wire(self, wiring: Wiring) -> None:
        """Store a wiring, safe against a power cut; versions without a reference are removed."""
        self._own()
        text = wiring.model_copy(update={"sha256": wiring.digest()}).model_dump_json(indent=1)
        write_durably(self.home / WIRING, text)
        kept = {wiring.active, *wiring.beside.values(), *[*wiring.rejected][-1:]}
        for path in self.home.iterdir():
            if path.is_dir() and path.name not in kept:
                shutil.rmtree(path, ignore_errors=True)

    def _own(self) -> None:
        if self._lock is not None:
            return
        self.home.mkdir(mode=0o700, parents=True, exist_ok=True)
        try:
            self._lock = locked(self.home, LOCK)
        except BlockingIOError:
            why = f"another service keeps its versions in {self.home}; give each its own --state"
            raise ContractError(why) from None
