"""What recordings still say after a restart of the service: how the last insertion ended, and where its object is."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from service.recordings.listing import list_recordings
from service.web.page.running import Running
from service.web.page.sentences import ended

MOST_GRASPS_N = 16  # of one object: as many insertions may continue one another


@dataclass(frozen=True, slots=True)
class Last:
    """How the last insertion ended; ``seconds``: its duration, None if not recorded.

    ``at_s``: when, on the wall clock; None for one from before this start, unless its object is being regrasped.
    """

    insertion_id: str
    outcome: str
    cause: str | None
    words: str
    attempts: int
    object: str
    at_s: float | None
    seconds: float | None = None


def newest(root: Path) -> tuple[Last | None, Running | None]:
    """How the last recorded insertion ended, and its state if another one may go on with its object."""
    listed, _ = list_recordings(root, most_n=MOST_GRASPS_N)
    if not listed:
        return None, None
    grasps = _grasps(listed)
    one, earlier_n = grasps[0], sum(before["descended_n"] for before in grasps[1:])
    attempts_n, afresh = earlier_n + one["attempts"], one["cause"] == "afresh"
    named = (one["object"] or "").replace("_", " ")
    words = ended(one["outcome"], one["cause"], attempts_n, named, len(grasps) - 1)
    at_s = _ended_s(one) if afresh else None
    last = Last(one["insertion_id"], one["outcome"], one["cause"], words, attempts_n, named, at_s, one["seconds"])
    if one["outcome"] == "inserted":
        return last, None
    put_back = Running(one["insertion_id"], object=named, afresh_n=len(grasps) - 1)
    put_back.descended_n = earlier_n + one["descended_n"]
    return last, put_back


def _grasps(listed: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The newest insertion, then the one whose object it continued with, and so on."""
    grasps = listed[:1]
    for one in listed[1:]:
        if one["insertion_id"] == grasps[-1]["continues"]:
            grasps.append(one)
    return grasps


def _ended_s(one: dict[str, Any]) -> float:
    started = datetime.strptime(one["started"], "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
    return started.timestamp() + (one["seconds"] or 0.0)
