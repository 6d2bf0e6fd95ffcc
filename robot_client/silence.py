"""How long a link has been silent, as far as this process could have heard it."""

from dataclasses import dataclass


@dataclass(slots=True)
class Silence:
    """Watch of one link. Time in which this process itself did not run does not count: what came then is read first.

    ``bound_s`` of silence is too much; ``period_s`` is how often :meth:`over` is asked.
    """

    bound_s: float
    period_s: float
    _heard_s: float | None = None
    _asked_s: float | None = None

    def heard(self, now_s: float) -> None:
        self._heard_s = now_s

    def over(self, now_s: float) -> float | None:
        """Seconds of silence if they exceed the bound, else None; never before something was heard."""
        late_s = 0.0 if self._asked_s is None else max(0.0, now_s - self._asked_s - 2.0 * self.period_s)
        self._asked_s = now_s
        if self._heard_s is None:
            return None
        self._heard_s = min(now_s, self._heard_s + late_s)
        silent_s = now_s - self._heard_s
        return silent_s if silent_s > self.bound_s else None
