"""Health of the EGM stream: order, gaps, age, readiness of the controller. Pure; the driver owns socket and clock."""

from dataclasses import dataclass
from typing import Any

from robot_client.insertion.motion import CYCLE_S, MISSED_CYCLES
from robot_client.robots.abb_egm.codec import RobotState
from robot_client.silence import Silence

_BAD_IN_A_ROW = _SLOW_IN_A_ROW = 25
_LONGEST_CYCLE_MS = round(MISSED_CYCLES * CYCLE_S * 1e3)
_DRIFT = 2e-4  # two quartz clocks may drift apart this fast without a datagram being late


class StreamFault(Exception):  # noqa: N818 it reports the stream's state, the driver turns it into a Failure event
    """The stream must not be followed; ``code`` and ``detail`` go into the Failure event."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(f"{code}: {detail}")
        self.code = code
        self.detail = detail


@dataclass(slots=True)
class EgmWatch:
    """Counts and checks datagrams. Age is measured against the least delay of this stream."""

    silence: Silence
    max_age_s: float
    datagrams: int = 0
    bad_datagrams: int = 0
    repeated: int = 0
    gaps: int = 0
    worst_gap_s: float = 0.0
    worst_age_s: float = 0.0
    not_ready: str = ""
    leans: str = ""  # stays the reason: unanswered, the controller's program ends by itself
    _bad_in_a_row: int = 0
    _slow_in_a_row: int = 0
    _cycle_ms: int = 0
    _last: RobotState | None = None
    _robot_s: float = 0.0  # since the first datagram, on the robot's clock
    _newest_s: float | None = None
    _least_lag_s: float | None = None
    _age_s: float = 0.0

    def bad(self, reason: str) -> None:
        """A datagram that does not decode; only valid ones keep the stream alive."""
        self.bad_datagrams += 1
        self._bad_in_a_row += 1
        self.not_ready = self.leans or reason

    def take(self, state: RobotState, now_s: float) -> float | None:
        """Time in s on the robot's clock since the last datagram; None for a repeated or reordered one."""
        last = self._last or state
        if self._last is not None and not 0 < (state.sequence - last.sequence) % 2**32 < 2**31:
            self.repeated += 1
            return None
        step_ms = (state.time_ms - last.time_ms + 2**31) % 2**32 - 2**31  # their clock wraps
        if (state.sequence - last.sequence) % 2**32 == 1:  # none is missing between them
            self._cycle_ms = step_ms
            self._slow_in_a_row = self._slow_in_a_row + 1 if step_ms > _LONGEST_CYCLE_MS else 0
        self._robot_s += step_ms / 1e3
        elapsed_s = max(0.0, step_ms / 1e3)
        if self._newest_s is not None and now_s - self._newest_s > 0.014:
            self.gaps += 1
            self.worst_gap_s = max(self.worst_gap_s, now_s - self._newest_s)
        self.silence.heard(now_s)
        self._last, self._newest_s, self._bad_in_a_row = state, now_s, 0
        lag_s = now_s - self._robot_s
        drifted_s = lag_s if self._least_lag_s is None else self._least_lag_s + _DRIFT * elapsed_s
        self._least_lag_s = min(drifted_s, lag_s)
        self._age_s = lag_s - self._least_lag_s
        self.worst_age_s = max(self.worst_age_s, self._age_s)
        return elapsed_s

    def ready(self, state: RobotState) -> bool:
        """True if the controller follows targets; ``not_ready`` names the missing condition."""
        self.not_ready = self.leans or state.unfit
        if self.not_ready:  # it may be of an earlier run: the next one counts its datagrams anew
            self._last = self._least_lag_s = None
        return not self.not_ready

    def upright(self, tilt_deg: float, most_deg: float) -> bool:
        """Whether the tool hangs as targets assume, within ``most_deg``; if not, it is never ready any more."""
        if tilt_deg > most_deg:
            remedy = "jog it upright, or correct work_object.rotation and .tool"
            self.leans = self.not_ready = f"the tool is tilted by {tilt_deg:.2f} deg, allowed {most_deg:g}; {remedy}"
        return not self.leans

    def check(self, state: RobotState) -> None:
        """Raise StreamFault if the controller no longer follows, or its datagrams come late or too seldom."""
        if state.unfit:
            raise StreamFault("controller", state.unfit)
        if self._slow_in_a_row >= _SLOW_IN_A_ROW:
            expected = f"expected {CYCLE_S * 1e3:g}, {_LONGEST_CYCLE_MS} at most: see SampleRate of EGMActPose"
            raise StreamFault("slow", f"the controller sends every {self._cycle_ms} ms, {expected}")
        if self._age_s > self.max_age_s:
            raise StreamFault(
                "stale", f"datagrams are {self._age_s * 1e3:.0f} ms late, allowed {self.max_age_s * 1e3:g}"
            )

    def check_silence(self, now_s: float) -> None:
        """Raise StreamFault if no new valid datagram came for too long."""
        silent_s = self.silence.over(now_s)
        if silent_s is not None:
            why = (
                "only unreadable ones came" if self._bad_in_a_row >= _BAD_IN_A_ROW else "the stream is silent or frozen"
            )
            raise StreamFault("silent", f"no new datagram for {silent_s * 1e3:.0f} ms: {why}")

    def statistics(self) -> dict[str, Any]:
        """Counts, and the worst gap and age in ms."""
        return {
            "datagrams": self.datagrams,
            "bad_datagrams": self.bad_datagrams,
            "repeated": self.repeated,
            "gaps": self.gaps,
            "worst_gap_ms": round(self.worst_gap_s * 1e3, 1),
            "worst_age_ms": round(self.worst_age_s * 1e3, 1),
        }
