"""Where an attempt stopped because of what was pressed, and what is known of its contact."""

import math

from robot_client.insertion.events import Event, FromService, Standstill, Stood
from robot_client.insertion.state import Phase, State
from robot_client.session.runner import Observer
from service.contract import wire
from service.contract.frames import Contract


class Stop(Contract):
    """Where a press ended: ``depth_mm`` below the armed pose.

    ``waited_s``: from the capture of the frame that ordered the stop, by its stamp, to the order. ``pressed_mm``: what
    that frame showed of the press. ``frame_s``: mean time from one judged frame of the descent to the next.
    """

    speed_mm_s: float
    depth_mm: float
    waited_s: float
    pressed_mm: float
    frame_s: float

    @property
    def touch_mm(self) -> float:
        """Depth of the contact by this press; later than it is by the travel in the lateness."""
        return self.depth_mm - self.speed_mm_s * self.waited_s - self.pressed_mm

    def past_contact_mm(self, late_s: float) -> float:
        """How far the arm went from the contact to its standstill, if pictures and arm are late by ``late_s``."""
        return self.pressed_mm + self.speed_mm_s * (self.waited_s + late_s)


class StopWatch(Observer):
    """Observer that keeps the stop of an attempt that ends because it was pressed enough, or slips, until the next one.

    None is kept after a slip without a known press, nor where the arm stood on the way for want of a judged frame or of
    guidance: then its travel is not its speed times the time.
    """

    def __init__(self) -> None:
        self.stop: Stop | None = None
        self._ordered: tuple[float, float, float] | None = None
        self._judged_ns: list[int] = []
        self._until_s, self._paused = math.inf, False

    def on_event(self, state: State, event: Event) -> None:
        """``event`` has led to ``state``."""
        if state.phase is Phase.ARMING:
            self.stop = self._ordered = None
            self._judged_ns = []
            self._until_s, self._paused = math.inf, False
        descends = state.phase is Phase.DESCENDING
        self._paused |= isinstance(event, Stood) or event.at_s >= self._until_s
        self._until_s = state.until_s if descends else math.inf
        if descends and isinstance(event, FromService) and isinstance(event.message, wire.Watching):
            self._judged_ns.append(event.message.frame_captured_ns)
        if isinstance(event, FromService) and isinstance(event.message, wire.Enough | wire.Slip) and state.clock:
            pressed_mm = event.message.pressed_mm
            if state.phase is Phase.STOPPING and self._ordered is None and pressed_mm is not None and not self._paused:
                stamp_s = state.clock.ours_s(event.message.captured_ns, event.at_s) + 0.5 * state.clock.uncertainty_s
                self._ordered = state.speed_mm_s, event.at_s - stamp_s, pressed_mm
        elif isinstance(event, Standstill) and self._ordered and state.armed and self.stop is None:
            speed_mm_s, waited_s, pressed_mm = self._ordered
            depth_mm = state.armed.z_mm - event.pose.z_mm
            self.stop = Stop(
                speed_mm_s=speed_mm_s,
                depth_mm=depth_mm,
                waited_s=waited_s,
                pressed_mm=pressed_mm,
                frame_s=self._frame_s(),
            )

    def _frame_s(self) -> float:
        if len(self._judged_ns) < 2:
            return 0.0
        return (self._judged_ns[-1] - self._judged_ns[0]) * 1e-9 / (len(self._judged_ns) - 1)
