"""Time budget of an insertion: by what the client waited for, from the approach to the end. Pure."""

from dataclasses import dataclass, field

from robot_client.insertion.events import Event, FromService
from robot_client.insertion.state import Phase, State
from service.contract import wire

NAMES = {
    Phase.APPROACHING: "approach",
    Phase.ARMING: "arm",
    Phase.DESCENDING: "guarded descent",
    Phase.STOPPING: "stop",
    Phase.DECIDING: "wait for frames",
    Phase.RETRACTING: "retract",
    Phase.CORRECTING: "correct",
    Phase.CLOSING: "confirm",
}
FAST, DECIDE, AFRESH = "fast descent", "decide", "regrasp"
PARTS = (
    *("approach", "arm", FAST, "guarded descent", "stop", "wait for frames", DECIDE),
    *("retract", "correct", "confirm", AFRESH),
)


@dataclass(slots=True)
class Seconds:
    """Adds up the time in each phase from the events; ``spent`` s by the names of PARTS.

    A fast leg of a descent counts as fast from the middle of the change to its speed. In a decision, "decide" is the
    time after the last frame that it read, as far as the service reports it. AFRESH is the time of putting an object
    back.
    """

    spent: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    _name: str = ""
    _since_s: float = 0.0

    @property
    def total_s(self) -> float:
        return sum(self.spent.values())

    def on_event(self, state: State, event: Event) -> None:
        """``event`` has led to ``state``."""
        name = NAMES.get(state.phase, "")
        if state.phase is Phase.DESCENDING and state.speed_mm_s > state.plan.ramps.descend.speed_mm_s:
            name = FAST
        if name == self._name:
            return
        if self._name:
            self.spent[self._name] += event.at_s - self._since_s
            self._decided(event)
        self._name, self._since_s = name, event.at_s

    def _decided(self, event: Event) -> None:
        if isinstance(event, FromService) and isinstance(event.message, wire.Correction):
            after_s = event.message.latency_ms.get("since_last_frame", 0.0) / 1e3
            after_s = min(after_s, event.at_s - self._since_s)
            self.spent[self._name] -= after_s
            self.spent[DECIDE] += after_s
