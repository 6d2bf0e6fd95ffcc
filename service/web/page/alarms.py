"""Alarms: each stays until a person has acknowledged it, also across a restart of the service."""

import contextlib
import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from service.durable import write_durably

Level = Literal["stop", "warning"]
KEPT_N = 50
EARLIER = "earlier"  # key of the one alarm that stands for the oldest of too many
FILE = "alarms.json"
_disk = ThreadPoolExecutor(1, "alarms")  # a slow one keeps no event waiting


@dataclass(slots=True)
class Alarm:
    """``key`` names the fault: while an alarm with the same key is unacknowledged, a repetition is only counted.

    ``at_s`` is the wall clock of the last occurrence; ``acknowledged_s`` None until a person has acknowledged it.
    ``remedy``: the operator's action, ``insertion_id``: the insertion that it ended.
    """

    number: int
    key: str
    level: Level
    title: str
    detail: str = ""
    remedy: str = ""
    insertion_id: str | None = None
    at_s: float = 0.0
    times_n: int = 1
    acknowledged_s: float | None = None


class Alarms:
    """The newest ``KEPT_N`` alarms, stored in a file; no unacknowledged one is lost. One thread at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.all: list[Alarm] = []
        with contextlib.suppress(OSError, ValueError, TypeError):  # a broken file must not keep a cell from starting
            kept = _disk.submit(path.read_text).result()  # behind what is being written
            self.all = [Alarm(**entry) for entry in json.loads(kept)]

    @property
    def open(self) -> list[Alarm]:
        return [alarm for alarm in self.all if alarm.acknowledged_s is None]

    def shown(self, most_n: int) -> list[Alarm]:
        """All unacknowledged ones, newest first, then acknowledged ones up to ``most_n`` in all."""
        acknowledged = [alarm for alarm in self.all if alarm.acknowledged_s is not None]
        return [*self.open, *acknowledged[: max(0, most_n - len(self.open))]]

    def sound(self, key: str, level: Level, title: str, late_s: float = 0.0, /, **facts: str | None) -> Alarm:
        """Raise an alarm for what happened ``late_s`` ago."""
        alarm = next((a for a in self.open if a.key == key), None)
        if alarm is None:
            number = 1 + max((a.number for a in self.all), default=0)
            alarm = Alarm(number, key, level, title, times_n=0)
        else:
            self.all.remove(alarm)
        for name, value in facts.items():
            setattr(alarm, name, value)
        alarm.at_s, alarm.times_n, alarm.title = time.time() - late_s, alarm.times_n + 1, title
        self.all = [alarm, *self.all]
        while len(self.all) > KEPT_N:
            self._shorten()
        self._keep()
        return alarm

    def _shorten(self) -> None:
        """Forget the oldest acknowledged alarm; where there is none, let one alarm stand for the two oldest."""
        acknowledged = [alarm for alarm in self.all if alarm.acknowledged_s is not None]
        if acknowledged:
            self.all.remove(acknowledged[-1])
            return
        newer, oldest = self.all[-2:]
        level: Level = "stop" if "stop" in {newer.level, oldest.level} else "warning"
        earlier_n = 1 + (oldest.times_n if oldest.key == EARLIER else 1)
        both = Alarm(oldest.number, EARLIER, level, "Earlier alarms", at_s=newer.at_s, times_n=earlier_n)
        both.detail, both.remedy = "More than the page keeps one by one.", "The history and the log have each of them."
        self.all[-2:] = [both]

    def acknowledge(self, number: int) -> bool:
        """Acknowledge an alarm on a person's behalf; False if there is no such alarm."""
        alarm = next((a for a in self.all if a.number == number), None)
        if alarm is None:
            return False
        alarm.acknowledged_s = alarm.acknowledged_s or time.time()
        self._keep()
        return True

    def _keep(self) -> None:
        """Have the alarms written; where that fails, the recordings' disk raises its own alarm."""
        _disk.submit(write_durably, self._path, json.dumps([asdict(alarm) for alarm in self.all]))
