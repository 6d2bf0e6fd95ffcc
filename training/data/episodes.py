"""Recordings of a cell as training data: the networks' input in each attempt, and its error.

The error is known in two ways. A probe (``purpose`` of the episode) begins at a known error, in the frame taught to the
arm, and each of its further attempts at another one. In a successful insertion, every earlier attempt was off by the
moves that followed it, to within what fits the gap: `training.adapt.hindsight` draws the rest. ``objects`` of the
samples says which: PROBE or WORK, and LATER for the attempts of an insertion after the first one, also those after a
regrasp. They are closer to the gap than a network's first question, so they are not used for evaluation.
"""

import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from service.contract import ContractError, Sensor
from service.contract.model_card import CONDITIONS
from service.contract.toml import read_toml
from service.contract.wire_parts import errors_left
from training.data.dataset import SPLITS
from training.data.pressed import Pressed
from training.networks.pressing import LATTICE, STEPS

PROBE, WORK, LATER = "probe", "work", "later"
FARTHEST = 1000.0
"""Beyond this (mm, deg), an error or a motion of the gel is in other units or damaged."""


class Attempt(NamedTuple):
    """One attempt with its error (mm, deg), from a PROBE, from WORK or from LATER work; fields as in `Pressed`.

    All attempts of a recording belong to one ``fixture``, one grasp of the object: cross-validation never splits them.
    Its name is the recording's.
    """

    known_of: str
    error: tuple[float, float]
    steps: NDArray[np.float32]
    conditions: NDArray[np.float32]
    fixture: str


@dataclass(frozen=True)
class Listed:
    """Of ``listed_n`` insertions that the record of a commissioning lists, ``present_n`` are in the folder ``root``.

    ``earlier_n`` recordings of work are older than all of these.
    """

    root: str
    listed_n: int
    present_n: int
    earlier_n: int

    def text(self) -> str:
        skipped = f", {self.earlier_n} recordings of earlier work are skipped" if self.earlier_n else ""
        return f"{self.present_n} of {self.listed_n} listed insertions are in {self.root}{skipped}"


def read_episodes(root: Path, sensor: Sensor, record: Path | None = None) -> Pressed:
    """All attempts below ``root`` with a known error, in order of time, as training samples.

    ``record`` of a commissioning: see `recordings_of`. Raises ContractError where there is none, where an attempt was
    recorded on another lattice or under other conditions, or where a recording is there twice.
    """
    folders, _ = recordings_of(root, record)
    attempts = [attempt for folder in folders for attempt in _attempts(folder)]
    if not attempts:
        raise ContractError(
            f"{root}: {len(folders)} recordings and no attempt whose error is known; expected probes or insertions that"
            " went in after a correction, decided by networks that read depth"
        )
    _refuse_copies(root, attempts)
    return pressed_of(attempts, sensor)


def recordings_of(root: Path, record: Path | None = None) -> tuple[list[Path], Listed | None]:
    """The recordings below ``root``, in order of time; those that a ``record``, if given, vouches for.

    Of all probes these are the listed ones. Work before them was of another setting, maybe with another gel. The names
    of recordings tell the order: the record's own time is of another clock.

    Raises ContractError without such a folder, or where it holds none of those probes.
    """
    if not root.is_dir():
        raise ContractError(f"{root}: no such folder, expected one with recordings")
    folders = sorted(path.parent for path in root.glob("*/summary.json"))
    if record is None:
        return folders, None
    listed, summaries = _listed(record), {folder: _summary(folder) for folder in folders}
    probes = {folder: str(of.get("insertion_id")) for folder, of in summaries.items() if of.get("purpose") == PROBE}
    present = {folder: name for folder, name in probes.items() if name in listed}
    if not present:
        held = f"which holds {len(probes)} other probes among {len(folders)} recordings"
        raise ContractError(f"{root}, {held}, holds none of the {len(listed)} insertions that {record} lists")
    work = [folder for folder in folders if folder not in probes]
    later = [folder for folder in work if folder > min(present)]
    earlier = [folder for folder in work if folder < min(present) and summaries[folder].get("purpose") != "timing"]
    there = Listed(str(root), len(listed), len({*present.values()}), len(earlier))
    return sorted([*present, *later]), there


def cells_of(root: Path, samples: Pressed) -> dict[str, int]:
    """How many of the recordings that the samples are from are of a real cell and of a simulated one, or do not say."""
    stated = [json.loads((root / name / "summary.json").read_bytes()).get("simulated") for name in {*samples.groups}]
    kinds = {"real": False, "simulated": True, "not stated": None}
    return {kind: count for kind, value in kinds.items() if (count := stated.count(value))}


def _refuse_copies(root: Path, attempts: list[Attempt]) -> None:
    """A recording that is there twice would be held out of what was fitted to it."""
    fixtures: dict[tuple[Move, bytes], str] = {}
    for attempt in attempts:
        first = fixtures.setdefault((attempt.error, hashlib.sha256(attempt.steps.tobytes()).digest()), attempt.fixture)
        if first != attempt.fixture:
            raise ContractError(f"{root}: {attempt.fixture} is a copy of {first}; expected each recording once")


def pressed_of(attempts: list[Attempt], sensor: Sensor) -> Pressed:
    """Attempts as samples, all of the training split; an invisible marker is NaN."""
    count = len(attempts)
    fields = np.zeros((count, STEPS, 2, LATTICE.rows, LATTICE.columns, 2), np.float16)
    for row, attempt in zip(fields, attempts, strict=True):
        kept = attempt.steps[:STEPS]
        row[: len(kept)] = np.where(kept[..., 2:] > 0, kept[..., :2], np.nan)
    names = np.array([attempt.fixture for attempt in attempts])
    digest = hashlib.sha256(fields.tobytes() + names.tobytes())
    conditions = np.array([attempt.conditions for attempt in attempts], np.float32)
    return Pressed(
        error=np.array([attempt.error for attempt in attempts], np.float32),
        conditions=conditions,
        split=np.full(count, SPLITS.index("train")),
        objects=np.array([attempt.known_of for attempt in attempts]),
        groups=names,
        fields=fields,
        length=np.array([min(len(attempt.steps), STEPS) for attempt in attempts], np.int64),
        reach=conditions[:, 3],
        sha256=digest.hexdigest(),
        sensor=sensor,
    )


def _listed(record: Path) -> frozenset[str]:
    """The probes of a cell that was wired right, by insertion."""
    try:
        stated = read_toml(record)
        named, probes = stated["named"], [*stated["signs"], *stated["probes"]]
        listed = frozenset(str(probe["insertion_id"]) for probe in probes)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ContractError(f"{record} is no record of a commissioning: {error}") from error
    if named:
        raise ContractError(f"{record} names mistakes, and its probes have wrong labels: {'; '.join(named)}")
    return listed


def _summary(folder: Path) -> dict[str, Any]:
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        if not isinstance(summary, dict):
            raise TypeError("its summary is no object")
    except (OSError, ValueError, TypeError) as error:
        raise ContractError(f"{folder} is no recording of an insertion: {error}") from error
    return summary


def _attempts(folder: Path) -> Iterator[Attempt]:
    summary = _summary(folder)
    try:
        shown = {int(path.stem[-2:]): _shown(path) for path in sorted(folder.glob("attempt_[0-9][0-9].npz"))}
        moves = _moves(summary, shown)
        errors = _errors(summary, moves)
        if not (np.abs([off for off in errors if off is not None]) < FARTHEST).all():
            raise ValueError(f"the error of an attempt is no number of mm and deg below {FARTHEST:g}")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ContractError(f"{folder} is no recording of an insertion: {error}") from error
    probe = summary.get("purpose") == "probe"
    first = PROBE if probe else LATER if summary.get("continues") else WORK
    for index, (number, off) in enumerate(zip(moves, errors, strict=False)):
        inputs, _ = shown.get(number, (None, None))
        if off is not None and inputs is not None:
            yield Attempt(LATER if index and not probe else first, off, *inputs, folder.name)


Inputs = tuple[NDArray[Any], NDArray[Any]]
Move = tuple[float, float]


def _moves(summary: dict[str, Any], shown: dict[int, tuple[Inputs | None, Move]]) -> dict[int, Move]:
    """The move after each attempt, by its number. The summary names all of them, also those of a lost file."""
    if "decisions" not in summary:  # a simulated insertion
        return {number: move for number, (_, move) in shown.items()}
    moves: dict[int, Move] = {}
    for decided in summary["decisions"]:
        dx_mm, dtheta_deg = decided.get("correction") or (0.0, 0.0)
        moves[int(decided["attempt"])] = float(dx_mm), float(dtheta_deg)
    return moves


def _shown(path: Path) -> tuple[Inputs | None, Move]:
    """The networks' input in an attempt, None if they read no depth or it was not known, and the move that followed."""
    with _opened(path) as stored:
        decision = json.loads(str(stored["decision"]))
        moves = float(decision.get("dx_mm", 0.0)), float(decision.get("dtheta_deg", 0.0))
        paused = decision.get("reason") == "stale"  # the steps of a press in which the arm paused are of other depths
        if paused or "steps" not in stored:
            return None, moves
        steps, conditions = stored["steps"], np.asarray(stored["conditions"], np.float32)
    if steps.shape[1:] != (2, LATTICE.rows, LATTICE.columns, 3) or not len(steps):
        raise ValueError(f"{path.name} holds steps {list(steps.shape)}, expected {LATTICE}")
    if not (np.abs(steps) < FARTHEST).all():
        raise ValueError(f"{path.name} holds a step that is no number of mm below {FARTHEST:g}")
    if conditions.shape != (len(CONDITIONS),) or not np.isfinite(conditions).all():
        raise ValueError(f"{path.name} holds conditions {conditions}, expected {', '.join(CONDITIONS)}")
    return (steps, conditions), moves


@contextmanager
def _opened(path: Path) -> Iterator[Mapping[str, Any]]:
    """An attempt's arrays; of a file that a power cut left damaged, ValueError says so, and how to go on."""
    try:
        with path.open("rb") as stream:
            if stream.read(2) != b"PK":  # numpy takes anything else for data that may run code
                raise zipfile.BadZipFile("its beginning is lost")
            stream.seek(0)
            with np.load(stream) as stored:
                yield stored
    except (zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path.name} is damaged ({error}); remove it, and the other attempts are read") from error


def _errors(summary: dict[str, Any], moves: dict[int, Move]) -> list[Move | None]:
    """The error of each attempt, None where it is unknown."""
    if summary.get("purpose") == "probe":
        starts = [summary["approach"], *summary.get("starts", ())]
        known = {number: (float(at["x_mm"]), float(at["yaw_deg"])) for number, at in enumerate(starts, 1)}
        return [known.get(number) for number in moves]
    if summary.get("outcome") != "inserted":
        return [None] * len(moves)
    return [*errors_left([*moves.values()])]
