"""Where an attempt stopped because it was pressed enough, and what is known of its contact."""

from robot_client.insertion.events import Event, FromService, Standstill
from robot_client.insertion.state import Phase, State
from service.contract import wire
from service.contract.frames import Contract


class Stop(Contract):
    """Where a press ended: ``depth_mm`` below the armed pose.

    ``waited_s``: from the capture of the frame that ordered the stop, by its stamp, to the order. ``pressed_mm``: what
    that frame showed of the press.
    """

    speed_mm_s: float
    depth_mm: float
    waited_s: float
    pressed_mm: float

    @property
    def touch_mm(self) -> float:
        """Depth of the contact by this press; later than it is by the travel in the lateness."""
        return self.depth_mm - self.speed_mm_s * self.waited_s - self.pressed_mm

    def past_contact_mm(self, late_s: float) -> float:
        """How far the arm went from the contact to its standstill, if pictures and arm are late by ``late_s``."""
        return self.pressed_mm + self.speed_mm_s * (self.waited_s + late_s)


class StopWatch:
    """Observer that keeps the stop of an attempt that ends because it was pressed enough, until the next is armed."""

    def __init__(self) -> None:
        self.stop: Stop | None = None
        self._ordered: tuple[float, float, float] | None = None

    def on_event(self, state: State, event: Event) -> None:
        """``event`` has led to ``state``."""
        if state.phase is Phase.ARMING:
            self.stop = self._ordered = None
        if isinstance(event, FromService) and isinstance(event.message, wire.Enough) and state.clock:
            if state.phase is Phase.STOPPING and self._ordered is None:
                stamp_s = state.clock.ours_s(event.message.captured_ns, event.at_s) + 0.5 * state.clock.uncertainty_s
                self._ordered = state.speed_mm_s, event.at_s - stamp_s, event.message.pressed_mm
        elif isinstance(event, Standstill) and self._ordered and state.armed and self.stop is None:
            speed_mm_s, waited_s, pressed_mm = self._ordered
            depth_mm = state.armed.z_mm - event.pose.z_mm
            self.stop = Stop(speed_mm_s=speed_mm_s, depth_mm=depth_mm, waited_s=waited_s, pressed_mm=pressed_mm)

    def summary(self) -> dict[str, object]:
        """Empty: the record has the stop."""
        return {}
