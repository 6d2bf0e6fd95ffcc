"""Control charts for drift in a cell: one CUSUM per chart, on a value's rank among the first ones of its object.

Ranks have the same distribution whatever the value, so one limit serves all (Page 1954; normal scores). In control,
three charts of a hundred alarm within 1,000 insertions; a shift by one standard deviation is detected after about 24.
"""

import bisect
import contextlib
import json
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import NamedTuple

from service.durable import write_durably

LEARNT_N = 100  # insertions of an object
OBJECTS_N = 32  # with stored first insertions; values of later objects are not compared
SLACK, LIMIT, MOST = 0.5, 12.0, 24.0  # standard deviations; sums are capped at MOST, so that an alarm can end
SUPPORTS = 0.5 * LIMIT  # from here on another chart supports a cause
SIDES = {"light": (-1, 1), "markers": (-1,), "gel": (1,), "reach": (-1, 1), "coverage": (-1,), "trials": (1,)}


class Cause(NamedTuple):
    """The cause behind one side of a chart, if no chart before it signals, too."""

    chart: str
    side: int
    what: str
    remedy: str


ANEW = "commission again, in a new folder"  # each calibration renames the gels, and the client refuses unknown ones
ADAPT = f"{ANEW.capitalize()}, and adapt the networks to that; or go back a version."
CAUSES = (
    Cause("light", -1, "changed light", f"Clean the finger's window, look at its lamp; else calibrate and {ANEW}."),
    Cause("light", 1, "changed light", f"Look for stray light and at the finger's lamp; else calibrate and {ANEW}."),
    Cause("markers", -1, "worn gel", f"Look at both gels; replace the one that lacks dots, calibrate and {ANEW}."),
    Cause("gel", 1, "new gel", f"A gel was changed, or has moved in its holder: calibrate and {ANEW}."),
    Cause("reach", -1, "slipping fingers", "Clean the gels; check the gripper's force."),
    Cause("reach", 1, "new gel", f"A gel or the grip holds more than before: {ANEW}."),
    Cause("coverage", -1, "networks that fit no longer", ADAPT),
    Cause("trials", 1, "networks that fit no longer", ADAPT),
)
_NORMAL = NormalDist()


@dataclass(slots=True)
class Chart:
    """``learnt``: sorted first values by object. ``high`` and ``low`` are the two sums.

    ``alarmed``: it has crossed its limit and has not fallen by half since.
    """

    learnt: dict[str, list[float]] = field(default_factory=dict)
    high: float = 0.0
    low: float = 0.0
    alarmed: bool = False

    def add(self, value: float, of: str) -> None:
        """Learn from one of an object's first values, or compare with them."""
        first = self.learnt.get(of)
        if first is None:
            if len(self.learnt) == OBJECTS_N:
                return
            first = self.learnt[of] = []
        if len(first) < LEARNT_N:
            bisect.insort(first, value)
            return
        usual = sum(_score(first, one) for one in first) / LEARNT_N
        off = _score(first, value) - usual
        self.high = min(MOST, max(0.0, self.high + off - SLACK))
        self.low = min(MOST, max(0.0, self.low - off - SLACK))

    def sum(self, side: int) -> float:
        """The sum on the high side (1) or the low one (-1)."""
        return self.high if side > 0 else self.low


def _score(first: list[float], value: float) -> float:
    """The normal score of a value's rank among the first ones."""
    ranks = bisect.bisect_left(first, value) + bisect.bisect_right(first, value)
    return _NORMAL.inv_cdf((0.5 * ranks + 0.5) / (len(first) + 1))


class Charts:
    """All charts of a cell, kept in a file. Thread safe."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        self._within = ""
        self._charts = {name: Chart() for name in SIDES}
        with contextlib.suppress(OSError, ValueError, TypeError, KeyError):  # a broken file must not stop a cell
            kept = json.loads(path.read_text())
            self._charts = {name: Chart(**kept["charts"][name]) for name in SIDES}
            self._within = str(kept["within"])

    def level(self, name: str) -> float:
        """Level of a chart relative to its limit, which is 1."""
        return max(self._charts[name].sum(side) for side in SIDES[name]) / LIMIT

    def add(self, values: Mapping[str, float], of: str, within: str) -> list[tuple[str, Cause]]:
        """Add one insertion's values by chart; returns the charts that alarm with it, and the likeliest cause of each.

        ``within`` names gels and networks: with others everything is learnt again.
        """
        with self._lock:
            if within != self._within:
                self._within, self._charts = within, {name: Chart() for name in SIDES}
            return [
                (name, self._cause(name)) for name in SIDES if name in values and self._crosses(name, values[name], of)
            ]

    def keep(self) -> None:
        """Store the charts in their file. Raises OSError if that cannot be done; they continue in memory."""
        with self._lock:
            whole = {"within": self._within, "charts": {name: asdict(chart) for name, chart in self._charts.items()}}
            write_durably(self._path, json.dumps(whole))

    def _crosses(self, name: str, value: float, of: str) -> bool:
        chart = self._charts[name]
        chart.add(value, of)
        before, chart.alarmed = chart.alarmed, self.level(name) >= (0.5 if chart.alarmed else 1.0)
        return chart.alarmed and not before

    def _cause(self, name: str) -> Cause:
        """The first cause of all signalling charts, which include the chart itself."""
        least = dict.fromkeys(SIDES, SUPPORTS) | {name: LIMIT}
        return next(one for one in CAUSES if self._charts[one.chart].sum(one.side) >= least[one.chart])
