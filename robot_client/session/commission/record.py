"""The record of a cell's commissioning, which `insert --live` demands."""

import hashlib
import json
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError
from pydantic_core import to_json

from robot_client.session.commission.lateness import Press, late_s
from robot_client.session.commission.wiring import SIDES, Probe, mistakes
from service.contract.frames import Contract, ContractError, Finger, first_error
from service.contract.toml import read_toml, toml_text
from service.durable import write_durably

RECORD = "commissioning.toml"
ANEW = "move its folder away and commission the cell again"

HEAD = "# The commissioning of a cell. `insert --live` refuses it, and whatever it names, where it was edited.\n"


class Record(Contract):
    """A stored commissioning. ``seed`` determines the errors of all probes, ``named`` are mistakes of the cell.

    ``gels`` are those of its first probe, by the service's names. ``approach_z_mm``: its task's,
    then. ``presses`` continued until the gel slid, two at each grip. ``pictures``: files beside it, with their SHA-256.
    ``timed`` are the presses at two speeds. ``sha256`` covers all other fields as written.
    """

    version: Literal[3] = 3
    begun: str
    seed: int = Field(ge=0)
    object: str = ""
    approach_z_mm: float | None = None
    gels: dict[Finger, str] = Field(default_factory=dict)
    signs: tuple[Probe, ...] = ()
    named: tuple[str, ...] = ()
    presses: tuple[Probe, ...] = ()
    timed: tuple[Press, ...] = ()
    probes: tuple[Probe, ...] = ()
    pictures: dict[str, str] = Field(default_factory=dict)
    sha256: str = ""

    @property
    def labelled_n(self) -> int:
        """Number of probes to learn from: those of the wiring check have a known error like the others."""
        return len(self.signs) + len(self.probes)

    @property
    def done_n(self) -> int:
        """Number of probes in all: those to learn from, and the presses that identify the gel."""
        return self.labelled_n + len(self.presses)

    @property
    def late_s(self) -> float | None:
        """How late pictures and arm are together at most, s; None if it was not measured."""
        return late_s(self.timed)

    def digest(self, *, as_read: bool = False) -> str:
        """SHA-256 of all other fields as its file has them, or of those it had: one of an older release has fewer."""
        content = self.model_dump(mode="json", exclude={"sha256"}, exclude_none=True, exclude_unset=as_read)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def commissioned(path: Path) -> Record:
    """The record of a cell that may insert; raises ContractError for an uncommissioned cell, or named mistakes."""
    record = read_record(path)
    if record is None:
        raise ContractError(
            f"{path}: there is no such file; run `commission --live --config FILE`, or name its whole path"
        )
    if len(record.signs) < len(SIDES):
        raise ContractError(f"{path}: this cell was not commissioned to the end; run `commission --live --config FILE`")
    if named := record.named or mistakes(record.signs):  # it may have been interrupted before they were written
        raise ContractError(f"{path} names mistakes; mend them and commission again: {'; '.join(named)}")
    return record


def read_record(path: Path) -> Record | None:
    """The record at ``path``, None if there is none yet; raises ContractError for any other file, or if edited."""
    try:
        record = Record.model_validate_json(to_json(read_toml(path)))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ContractError(f"cannot read {path}: {error.strerror}") from None
    except ValueError as error:
        why = first_error(error) if isinstance(error, ValidationError) else str(error)
        raise ContractError(f"{path} is no record of a commissioning: {why}; {ANEW}") from None
    if record.sha256 != record.digest(as_read=True):
        raise ContractError(f"{path} is not as it was written: {ANEW}")
    for name, sha256 in record.pictures.items():
        picture = path.with_name(name)
        if not picture.is_file() or hashlib.sha256(picture.read_bytes()).hexdigest() != sha256:
            raise ContractError(f"{picture} is not as it was written: {ANEW}")
    return record


def keep_record(path: Path, record: Record) -> None:
    """Write it atomically, with its digest, so that a kill or a power cut leaves the previous record.

    So does a full disk: raises ContractError.
    """
    record = record.model_copy(update={"sha256": record.digest()})
    try:
        keep_text(path, HEAD + toml_text(record.model_dump(mode="json")))
    except ContractError as error:
        raise ContractError(f"{error}; the last probe is not in it") from None


def keep_text(path: Path, text: str) -> str:
    """Write a file of the record as atomically; returns its SHA-256."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text)
    except OSError as error:
        raise ContractError(f"cannot write {path}: {error.strerror}") from None
    return hashlib.sha256(text.encode()).hexdigest()
