"""The operator's report: each attempt as it happens, and one screen at the end. Also the rows of the episode log."""

from collections.abc import Callable
from typing import Any

from pydantic import Field

from robot_client.insertion.events import Event, FromService, Grasped, Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.seconds import Seconds
from robot_client.insertion.state import Phase, State
from robot_client.session.stops import StopWatch
from service.contract import wire
from service.contract.frames import Contract


class AttemptRow(Contract):
    """One attempt. Depths below the armed pose; ``overtravel_mm`` from the slip message to standstill.

    ``pressed_mm``: from the contact to standstill, with the lateness that the motion lease reckons with.
    """

    attempt: int
    x_mm: float = 0.0
    yaw_deg: float = 0.0
    tilt_deg: float = 0.0
    slip_depth_mm: float | None = None
    slip_finger: str = ""
    stop_depth_mm: float | None = None
    overtravel_mm: float | None = None
    pressed_mm: float | None = None
    probabilities: dict[str, float] = Field(default_factory=dict)
    confidence: float = 0.0
    estimate: tuple[float, float] | None = None
    correction: tuple[float, float] | None = None
    controller: str = ""
    reason: str = ""
    service_ms: dict[str, float] = Field(default_factory=dict)
    decided_after_ms: float | None = None


class Report:
    """Observer that collects the attempts and prints them."""

    def __init__(self, position: Callable[[], WorkPose | None], show: Callable[[str], None]) -> None:
        self.rows: list[AttemptRow] = []
        self.seconds = Seconds()
        self._position = position
        self._show = show
        self._phase = Phase.START
        self._stopped_s = 0.0
        self._watch = StopWatch()

    def on_event(self, state: State, event: Event) -> None:
        entered, self._phase = state.phase is not self._phase, state.phase
        self.seconds.on_event(state, event)
        self._watch.on_event(state, event)
        if isinstance(event, FromService):
            self._on_message(state, event.message, event.at_s)
        elif isinstance(event, Grasped):
            self._show(f"gripper holds the object, width {event.width_mm:.1f} mm")
        elif isinstance(event, Standstill) and self.rows and state.armed is not None:
            self._on_standstill(state.armed, state.plan.lease.stop_lag_s, event)
        if entered and state.phase is Phase.APPROACHING:
            self._show("approaching")
        if entered and state.phase is Phase.ARMING and state.armed is not None:
            armed = state.armed
            if self.rows and self.rows[-1].attempt == state.attempt:  # again, with the tool tilted
                self.rows.pop()
            self.rows.append(
                AttemptRow(attempt=state.attempt, x_mm=armed.x_mm, yaw_deg=armed.yaw_deg, tilt_deg=armed.tilt_deg)
            )
        if entered and state.phase is Phase.FAILED:
            self._show(f"HOLD  {state.reason}")

    def _on_message(self, state: State, message: wire.ServiceMessage, at_s: float) -> None:
        if isinstance(message, wire.ServiceHello):
            models = ", ".join(entry.card.name for entry in message.models) or "none"
            cameras = ", ".join(f"{camera.finger} {camera.state}" for camera in message.cameras) or "none"
            self._show(f"service: controller {message.controller}, models {models}, cameras {cameras}")
        elif not self.rows or getattr(message, "attempt", None) != self.rows[-1].attempt:
            return
        elif isinstance(message, wire.Slip) and self.rows[-1].slip_depth_mm is None:
            self._on_slip(state, message)
        elif isinstance(message, wire.Correction) and self.rows[-1].correction is None:
            self._on_correction(message, at_s)
        elif isinstance(message, wire.NoDecision):
            self._update(reason=f"no decision: {message.reason}: {message.detail}")
            self._show(_attempt_line(self.rows[-1]))

    def _on_slip(self, state: State, message: wire.Slip) -> None:
        here = self._position()
        if here is not None and state.armed is not None:
            depth_mm = state.armed.z_mm - here.z_mm
            self._update(slip_depth_mm=depth_mm, slip_finger=message.finger)

    def _on_standstill(self, armed: WorkPose, late_s: float, event: Standstill) -> None:
        self._stopped_s = event.at_s
        depth_mm = armed.z_mm - event.pose.z_mm
        slip_mm, stop = self.rows[-1].slip_depth_mm, self._watch.stop
        self._update(
            stop_depth_mm=depth_mm,
            overtravel_mm=None if slip_mm is None else depth_mm - slip_mm,
            pressed_mm=None if stop is None else stop.past_contact_mm(late_s),
        )
        if self._phase in (Phase.CLOSING, Phase.FAILED):
            self._show(_attempt_line(self.rows[-1]))

    def _on_correction(self, message: wire.Correction, at_s: float) -> None:
        self._update(
            probabilities=message.class_probabilities,
            confidence=message.confidence,
            estimate=(message.estimate.dx_mm, message.estimate.dtheta_deg),
            correction=(message.dx_mm, message.dtheta_deg),
            controller=message.controller,
            reason=message.reason,
            service_ms=message.latency_ms,
            decided_after_ms=(at_s - self._stopped_s) * 1e3,
        )
        for line in _correction_lines(self.rows[-1]):
            self._show(line)

    def _update(self, **values: Any) -> None:
        self.rows[-1] = self.rows[-1].model_copy(update=values)

    def summary(self) -> dict[str, Any]:
        """The rows and the time budget, for the episode log."""
        rows = [row.model_dump(mode="json") for row in self.rows]
        return {"rows": rows, "seconds": {name: round(spent, 3) for name, spent in self.seconds.spent.items()}}

    def final(self, state: State, farewell: str, link: dict[str, Any], rest: dict[str, Any]) -> list[str]:
        """One screen: outcome, attempts, overtravel, link, where the arm came to rest."""
        word = "INSERTED" if state.phase is Phase.INSERTED else "NOT INSERTED"
        lines = [f"{word} after {state.attempt} attempt{'s' if state.attempt != 1 else ''}"]
        if state.reason:
            lines.append(f"  reason      {state.reason}")
        lines += _grasp(state)
        over = [row.overtravel_mm for row in self.rows if row.overtravel_mm is not None]
        if over:
            mean_mm = sum(over) / len(over)
            lines.append(f"  overtravel  mean {mean_mm:.2f} mm, worst {max(over):.2f} mm after the slip message")
        pressed = [row.pressed_mm for row in self.rows if row.pressed_mm is not None]
        if pressed:
            mean_mm = sum(pressed) / len(pressed)
            lines.append(f"  pressed     mean {mean_mm:.1f} mm, worst {max(pressed):.1f} mm after the contact")
        waits = sorted(row.decided_after_ms for row in self.rows if row.decided_after_ms is not None)
        if waits:
            median_ms = waits[len(waits) // 2]
            lines.append(f"  decisions   median {median_ms:.0f} ms after standstill, worst {waits[-1]:.0f} ms")
        parts = ", ".join(f"{name} {spent:.1f}" for name, spent in self.seconds.spent.items() if spent >= 0.05)
        if parts:  # a rehearsal takes no time
            lines.append(f"  seconds     {self.seconds.total_s:.1f} since the approach began: {parts}")
        if link:
            lines.append("  arm link    " + ", ".join(f"{key} {value}" for key, value in link.items()))
        if rest:
            lines.append("  rest        " + ", ".join(f"{key} {value}" for key, value in rest.items()))
        lines.append(f"  robot       {farewell}")
        return lines


def _grasp(state: State) -> list[str]:
    """How far blocked attempts pushed an inserted object up in the hand, if it is enough to report."""
    creep_mm, plan = state.creep_mm, state.plan
    if state.phase is not Phase.INSERTED or creep_mm <= plan.depth_tolerance_mm:
        return []
    assert state.armed is not None
    assert state.pose is not None
    deeper_mm = state.armed.z_mm - state.pose.z_mm - plan.expected_depth_mm
    pushed = f"  grasp       pushed up about {creep_mm:.1f} mm in the hand by blocked attempts; "
    if creep_mm - deeper_mm <= plan.depth_tolerance_mm:
        return [f"{pushed}went {deeper_mm:.1f} mm deeper for it"]
    allowed = f"creep_allowance_mm is {plan.creep_allowance_mm:g}"
    return [f"{pushed}its bottom may be {creep_mm - deeper_mm:.1f} mm HIGHER than asked ({allowed})"]


def _attempt_line(row: AttemptRow) -> str:
    parts = [f"attempt {row.attempt:2d}  at x {row.x_mm:+6.2f} mm, yaw {row.yaw_deg:+6.2f} deg"]
    if abs(row.tilt_deg) >= 0.05:
        parts.append(f"tool tilted {row.tilt_deg:+.1f} deg")
    if row.slip_depth_mm is not None:
        parts.append(f"slip ({row.slip_finger}) at {row.slip_depth_mm:.2f} mm")
    if row.stop_depth_mm is not None:
        parts.append(f"stopped at {row.stop_depth_mm:.2f} mm")
    if row.overtravel_mm is not None:
        parts.append(f"overtravel {row.overtravel_mm:.2f} mm")
    if row.pressed_mm is not None:
        parts.append(f"{row.pressed_mm:.1f} mm after contact")
    if row.reason and row.correction is None:
        parts.append(row.reason)
    return ", ".join(parts)


def _correction_lines(row: AttemptRow) -> list[str]:
    assert row.estimate is not None
    assert row.correction is not None
    x_mm, yaw_deg = row.estimate
    took = f"service {sum(row.service_ms.values()):.1f} ms, {row.decided_after_ms or 0.0:.0f} ms after standstill"
    moved = f"correction {row.correction[0]:+.2f} mm, {row.correction[1]:+.2f} deg ({row.controller}; {took})"
    return [
        _attempt_line(row),
        f"            estimate x {x_mm:+.2f} mm, yaw {yaw_deg:+.2f} deg, {row.confidence:.0%} sure of the direction",
        f"            {moved}",
    ]
