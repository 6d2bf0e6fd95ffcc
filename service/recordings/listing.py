"""Contents of the recordings folder: finished insertions, and problems with the others."""

import contextlib
import math
from collections.abc import Iterator
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from service.contract.frames import first_error
from service.contract.replies import MEANT, descended_n
from service.contract.wire import Finished
from service.contract.wire_parts import errors_left
from service.recordings.names import NAME
from service.recordings.recovery import is_being_written
from service.recordings.writer import FINAL, UNREADABLE


class Decided(BaseModel):
    """One decided attempt. ``reach_pitch``: how far the gels were sheared when it stopped, in marker pitches.

    ``correction``: mm across the gap and degrees, as in `Correction`.
    """

    model_config = ConfigDict(extra="allow")
    attempt: int
    depth_mm: float | None = None
    reach_pitch: float | None = None
    correction: tuple[float, float] | None = None
    interval_x_mm: tuple[float, float] | None = None
    interval_theta_deg: tuple[float, float] | None = None


class Summary(BaseModel):
    """What ``summary.json`` says of a finished insertion; newer ones may say more, older ones say less.

    ``earlier_n``: attempts of the insertions that it ``continues``, where they are known.
    Of its last reference: ``markers_share`` that the worse finger showed, ``brightness_grey`` of both pictures. And
    ``gel_distance`` of the gel that is less like the one that was calibrated, when the open gels were learnt.
    """

    model_config = ConfigDict(extra="allow")
    insertion_id: str
    outcome: str
    attempts: int
    cause: str | None = None
    object: str | None = None
    continues: str | None = None
    earlier_n: int = 0
    seconds: float | None = None
    decisions: list[Decided] = []
    doubts: list[dict[str, Any]] = []
    markers_share: float | None = None
    brightness_grey: float | None = None
    gel_distance: float | None = None

    @property
    def tried_n(self) -> int:
        """The attempts that went down."""
        return descended_n(self.cause, self.attempts, self.doubts)

    @property
    def held_n(self) -> tuple[int, int]:
        """Number of 90 % intervals (of x, and of yaw) that held the pose of the insertion, and of all intervals.

        The error is known once the object is in: the reversed corrections from then on, apart from the clearance.
        """
        held = stated = 0
        if self.outcome != "inserted":
            return 0, 0
        errors = errors_left([decided.correction or (0.0, 0.0) for decided in self.decisions])
        for decided, error in zip(self.decisions, errors, strict=True):
            if decided.correction is None:
                continue
            intervals = zip((decided.interval_x_mm, decided.interval_theta_deg), error, strict=True)
            given = [(interval, truth) for interval, truth in intervals if interval is not None]
            stated += len(given)
            held += sum(interval[0] <= truth <= interval[1] for interval, truth in given)
        return held, stated

    @property
    def charted(self) -> dict[str, float]:
        """Values for the control charts; none from an insertion that ended as it was meant to, before it was in."""
        if self.outcome in MEANT.values():
            return {}
        held_n, stated_n = self.held_n
        reach = [one.reach_pitch for one in self.decisions if one.reach_pitch]
        decided = self.outcome == "inserted" or self.cause == "attempts"
        counted = self.earlier_n > 0 or not self.continues
        values = {
            "light": self.brightness_grey,
            "markers": self.markers_share,
            "gel": self.gel_distance,
            "reach": sum(reach) / len(reach) if reach else None,
            "coverage": held_n / stated_n if stated_n else None,
            "trials": float(self.earlier_n + self.attempts) if decided and counted else None,
        }
        return {name: value for name, value in values.items() if value is not None and math.isfinite(value)}


def list_recordings(root: Path, most_n: int | None = None) -> tuple[list[dict[str, Any]], list[str]]:
    """Finished insertions, newest first (the ``most_n`` newest), and the problems with the others."""
    problems: list[str] = []
    return list(islice(each_recording(root, problems), most_n)), problems


def endings(root: Path, most_n: int) -> list[Finished]:
    """How the ``most_n`` newest insertions ended, oldest first; one that broke off has failed."""
    known = []
    for one in reversed(list_recordings(root, most_n)[0]):
        how = {name: one[name] for name in ("insertion_id", "attempts", "cause", "doubts")}
        how |= {"outcome": "failed" if one["outcome"] == "interrupted" else one["outcome"]}
        with contextlib.suppress(ValidationError):  # of another release, whose words need not be ours
            known.append(Finished.model_validate(how | {"recording": str(root / one["name"] / FINAL)}, strict=False))
    return known


def each_recording(root: Path, problems: list[str], insertion_id: str | None = None) -> Iterator[dict[str, Any]]:
    """Finished insertions, newest first; what keeps others from being listed is added to ``problems``.

    ``insertion_id``: only those of this name, without reading any other.
    """
    try:
        folders = sorted((p for p in root.iterdir() if NAME.fullmatch(p.name)), reverse=True)
    except OSError as error:
        problems.append(f"{root}: {error.strerror}")
        return
    for folder in folders:
        if insertion_id not in (None, folder.name.partition("_")[2]):
            continue
        try:
            entry = _entry(folder)
            if not is_being_written(folder):  # one that has its summary gets the name of its file last
                yield entry
        except FileNotFoundError:
            if (folder / UNREADABLE).is_file():
                problems.append(f"{folder.name}: broken off before there was anything to read; remove it")
            elif any(folder.glob("*")) and not is_being_written(folder):
                problems.append(f"{folder.name}: broken off; the next start of the service recovers what can be read")
        except (OSError, ValueError) as error:
            problems.append(f"{folder.name}: summary.json: {_reason(error)}")


def _entry(folder: Path) -> dict[str, Any]:
    summary = Summary.model_validate_json((folder / "summary.json").read_bytes())
    stamp = datetime.strptime(folder.name[:15], "%Y%m%dT%H%M%S")  # noqa: DTZ007 - shown as it is, UTC
    held_n, stated_n = summary.held_n
    facts: dict[str, Any] = {"name": folder.name, "started": f"{stamp:%Y-%m-%d %H:%M:%S}"}
    facts |= {"intervals_held_n": held_n, "intervals_n": stated_n, "descended_n": summary.tried_n}
    return facts | summary.model_dump(mode="json")


def _reason(error: Exception) -> str:
    return first_error(error) if isinstance(error, ValidationError) else str(error)
