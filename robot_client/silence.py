"""Duration of a link's silence, as far as this process could have noticed it."""

from dataclasses import dataclass


@dataclass(slots=True)
class Silence:
    """Watch of one link. Time in which this process itself did not run does not count: pending messages are read first.

    ``bound_s``: the allowed silence; ``period_s``: how often :meth:`over` is called.
    """

    bound_s: float
    period_s: float
    _heard_s: float | None = None
    _asked_s: float | None = None

    def heard(self, now_s: float) -> None:
        self._heard_s = now_s

    def over(self, now_s: float) -> float | None:
        """Seconds of silence if they exceed the bound, else None; never before the first message."""
        late_s = 0.0 if self._asked_s is None else max(0.0, now_s - self._asked_s - 2.0 * self.period_s)
        self._asked_s = now_s
        if self._heard_s is None:
            return None
        self._heard_s = min(now_s, self._heard_s + late_s)
        silent_s = now_s - self._heard_s
        return silent_s if silent_s > self.bound_s else None
