"""Answers to the probes of a commissioning, as they come."""

from collections.abc import Callable
from typing import NamedTuple

from robot_client.insertion.events import Event, FromService
from robot_client.insertion.state import Plan, State
from robot_client.session.commission.wiring import Probe, probe_of
from robot_client.session.runner import Observer
from service.contract import wire
from service.contract.frames import Finger


class Answered(NamedTuple):
    """A probe as it is answered, and the service's gels."""

    probe: Probe
    gels: dict[Finger, str]


class Answers(Observer):
    """Observer that keeps the answers to the probes of a plan, and passes each of them on."""

    def __init__(self, plan: Plan, answered: Callable[[Answered], None]) -> None:
        self._plan, self._answered = plan, answered
        self._starts = iter((plan.approach, *plan.starts))
        self.probes: list[Probe] = []
        self.gels: dict[Finger, str] = {}
        self.rates_hz: tuple[float, ...] = ()
        self.slid_mm: float | None = None

    def on_event(self, state: State, event: Event) -> None:  # noqa: ARG002 the protocol's signature
        if not isinstance(event, FromService):
            return
        if isinstance(event.message, wire.ServiceHello):
            self.gels = {camera.finger: camera.gel for camera in event.message.cameras}
            self.rates_hz = tuple(camera.frame_rate_hz for camera in event.message.cameras if camera.frame_rate_hz)
        if isinstance(event.message, wire.Slip):
            self.slid_mm = event.message.pressed_mm
        if isinstance(event.message, wire.Correction | wire.NoDecision) and event.message.attempt > len(self.probes):
            self.take(event.message)

    def take(self, answer: wire.Correction | wire.NoDecision | None) -> None:
        """An attempt has been answered; None: it went in."""
        probe = probe_of(self._plan.insertion_id, next(self._starts), answer)
        self.probes.append(probe)
        self._answered(Answered(probe, self.gels))


def in_words(probe: Probe) -> str:
    """A probe in words."""
    answer = probe.said
    if probe.estimate_x_mm is not None and probe.estimate_theta_deg is not None:
        answer = f"felt {probe.estimate_x_mm:+.1f} mm, {probe.estimate_theta_deg:+.1f} deg"
    if probe.slid_mm is not None:
        answer += f"; slid once pressed by {probe.slid_mm:.1f} mm"
    return f"{probe.x_mm:+.1f} mm, {probe.theta_deg:+.1f} deg; {answer}"
