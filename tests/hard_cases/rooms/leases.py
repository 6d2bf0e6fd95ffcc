"""Hard leases: an arm that goes on only for frames that were judged, with every part of that taken away in turn.

A descent in virtual time: frames every 33 ms, judged 20 ms after their capture, an arm that lags by 20 ms behind its
targets. What is measured is its way in mm from the capture of the last judged frame to standstill.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from robot_client.insertion.events import Renew
from robot_client.insertion.lease import ClockMap, Lease, check_leased
from robot_client.insertion.limits import LimitError, Motion
from robot_client.insertion.state import State
from service.cameras.sources import capture_ns
from service.contract import FINGERS, Finger, TactileFrame, wire
from service.decision.attempt import Attempt, Stage
from service.perception.observation import Observation
from tests.hard_cases.descents import ANSWERED_S, BOUND_MM, END_S, ENDLESS, FAULT_S, Descent
from tests.hard_cases.registry import Guard, case, not_refused
from tests.hard_cases.rooms.links import MESSAGES


def without_end(advance: Callable[..., Any]) -> Callable[..., Any]:
    return lambda guide, elapsed_s, _now_s: advance(guide, elapsed_s, -ENDLESS)


def never_asked(on_tick: Callable[..., Any]) -> Callable[..., Any]:
    return lambda state, event: on_tick(replace(state, watched_s=ENDLESS), event)


@case(
    "motion",
    why="the service stops in mid-descent, and the client's event loop hangs with it: nothing tells the arm to stop",
    holds="the layer that computes each target lets it stand when the lease ends: mm after the last judged frame",
    guard=Guard("robot_client.insertion.motion:MotionGuide.advance", "targets are computed for ever", without_end),
    limit=BOUND_MM,
)
def service_silent_and_client_hung(_seed: int) -> float:
    descent = Descent(ticks=False)
    return descent.way_mm(descent.watched)


@case(
    "motion",
    why="another arm's driver may not know of leases",
    holds="the state machine holds it a tick after the lease has ended: mm after the last judged frame",
    guard=Guard("robot_client.insertion.machine:_on_tick", "a tick looks at the phase's deadline only", never_asked),
    limit=BOUND_MM,
)
def service_silent_before_a_driver_without_leases(_seed: int) -> float:
    descent = Descent(keeps=False)
    return descent.way_mm(descent.watched)


def counting_beats(on_clock: Callable[..., Any]) -> Callable[..., Any]:
    def counted(state: State, clock: wire.Clock | None, at_s: float) -> Any:
        state, commands = on_clock(state, clock, at_s)
        newer = replace(state, watched_s=max(state.watched_s, at_s))
        return newer, (*commands, Renew(until_s=newer.until_s))

    return counted


@case(
    "motion",
    why="cameras stand still or show black while the service answers every heartbeat at once",
    holds="heartbeats keep no arm moving: mm after the last judged frame",
    guard=Guard("robot_client.insertion.machine:_on_clock", "a heartbeat counts as watching", counting_beats),
    limit=BOUND_MM,
)
def heartbeats_without_frames(_seed: int) -> float:
    descent = Descent()

    def heard(now_s: float) -> list[Any]:
        sent_ns, service_ns = round((now_s - 0.002) * 1e9), descent.ns(now_s - 0.001)
        clock = wire.Clock(sent_ns=sent_ns, service_ns=service_ns)
        beat = wire.ServiceHeartbeat(insertion_id="t-1", count=1, clock=clock, frame_age_ms=1.0)
        return [*descent.watched(now_s), beat]

    return descent.way_mm(heard)


def by_arrival(watched: Callable[..., State]) -> Callable[..., State]:
    def taken(state: State, _captured_ns: int, at_s: float) -> State:
        assert watched
        return replace(state, watched_s=max(state.watched_s, at_s))

    return taken


@case(
    "motion",
    why="after a fault pictures come 100 to 300 ms late, or the last ones again and again, one by one down a slow link",
    holds="age is counted from capture, so late and repeated ones renew nothing: mm after the last picture in time",
    guard=Guard("robot_client.insertion.actions:watched", "a frame is as young as its message", by_arrival),
    limit=BOUND_MM,
)
def frames_late_and_repeated(seed: int) -> float:
    late_s = 0.1 * (1 + seed % 3)
    descent = Descent()

    def heard(now_s: float) -> list[Any]:
        again = descent.watched(now_s - late_s, END_S) if now_s > FAULT_S + late_s else []
        old = wire.Watching(**MESSAGES, frame_captured_ns=descent.ns(FAULT_S), judged_ns=descent.ns(now_s))
        return [*descent.watched(now_s), *again, *([old] if now_s > FAULT_S + 0.03 else [])]

    return descent.way_mm(heard)


def taken_up_again(renew: Callable[..., Any]) -> Callable[..., Any]:
    return lambda state, captured_ns, at_s: renew(replace(state, watched_s=at_s), captured_ns, at_s)


@case(
    "motion",
    why="a service that was stopped comes back with fresh frames, before anybody has asked the machine for the time",
    holds="a lease that has ended is not taken up again, so that nothing moves after a hold: mm",
    guard=Guard("robot_client.insertion.actions:renew", "a fresh frame renews an ended lease", taken_up_again),
    limit=BOUND_MM,
)
def fresh_frames_after_the_end(_seed: int) -> float:
    descent = Descent(ticks=False, keeps=False)

    def heard(now_s: float) -> list[Any]:
        back = now_s > FAULT_S + 0.112
        return descent.watched(now_s, END_S) if back or now_s <= FAULT_S + ANSWERED_S + 0.01 else []

    return descent.way_mm(heard)


def halved(_ours_s: Callable[..., float]) -> Callable[..., float]:
    return lambda mapped, stamp_ns, _at_s: stamp_ns * 1e-9 + (mapped.earliest_s + mapped.latest_s) / 2.0


@case(
    "motion",
    why="two machines' clocks are hours apart, and the way back takes 60 ms less than the way there, or more",
    holds="the whole round trip counts as age: mm after the last judged frame",
    guard=Guard("robot_client.insertion.lease:ClockMap.ours_s", "half of the round trip each way is assumed", halved),
    limit=BOUND_MM,
)
def clocks_of_two_machines(seed: int) -> float:
    rng = np.random.default_rng(seed)
    descent = Descent(offset_s=float(rng.uniform(-1e5, 1e5)), there_s=0.001, back_s=0.045)
    return descent.way_mm(descent.watched)


def any_reading(_narrowed: Callable[..., Any]) -> Callable[..., Any]:
    return lambda _mapped, other: other


@case(
    "motion",
    why="a clock stands still while its machine sleeps: frames from before look younger than they are",
    holds="a mapping that contradicts the earlier ones ends the descent: mappings that are accepted",
    guard=Guard("robot_client.insertion.lease:ClockMap.narrowed", "the newest reading is believed", any_reading),
)
def clocks_that_stood_still(seed: int) -> float:
    slept_s = 0.2 + seed
    mapped = ClockMap.read(wire.Clock(sent_ns=0, service_ns=0), 0.002)
    asleep = [(1.0, 1.0 + slept_s), (1.0 + slept_s, 1.0)]
    after = [ClockMap.read(wire.Clock(sent_ns=round(c * 1e9), service_ns=round(s * 1e9)), c + 0.002) for c, s in asleep]
    return float(sum(mapped.narrowed(read) is not None for read in after))


def for_one(_watching: Callable[..., Any]) -> Callable[..., Any]:
    def watching(attempt: Attempt, observation: Observation, now_ns: int) -> Iterator[wire.Watching]:
        yield wire.Watching(**attempt.named, frame_captured_ns=observation.captured_ns, judged_ns=now_ns)

    return watching


def observed(finger: Finger, captured_ns: int, status: str = "tracking", state: str = "hold") -> Observation:
    """The part of an observation that shows whether it was judged."""
    field_ = type("Field", (), {"usable": status == "tracking", "status": status})()
    slip = type("Slip", (), {"state": state, "stop": False})()
    image = np.zeros((1, 1, 3), np.uint8)
    frame = TactileFrame(finger, captured_ns, captured_ns, image)
    return Observation(finger, frame.seq, captured_ns, image, field_, slip, None, {})


def armed() -> Attempt:
    """An attempt that watches, armed by frames of time 0."""
    arm = wire.Arm(**MESSAGES, gap_width_mm=56.0, expected_depth_mm=25.0)
    return Attempt(arm, 0, 1, stage=Stage.ARMED)


@case(
    "perception",
    why="one camera goes on while the other one stands still",
    holds="one finger alone keeps no arm moving, neither detects slip for the other: messages",
    guard=Guard("service.decision.attempt:Attempt.watching", "any finger will do", for_one),
)
def one_finger_alone(seed: int) -> float:
    attempt, finger = armed(), FINGERS[seed % 2]
    return float(sum(len([*attempt.watching(observed(finger, n), n)]) for n in range(1, 30)))


@case(
    "perception",
    why="frames come in time and are black, repeated, or show markers that nothing can be said of",
    holds="frames that say nothing about slip are not judged: messages",
    guard=Guard(
        "service.perception.observation:Observation.informative",
        "every frame that came was judged",
        lambda _: property(lambda _observation: True),
    ),
)
def frames_that_say_nothing(_seed: int) -> float:
    blind = (("no_grid", "unknown"), ("lost", "lost"), ("duplicate", "hold"), ("tracking", "unknown"))
    count = 0
    for status, state in blind:
        attempt = armed()
        count += sum(len([*attempt.watching(observed(f, n, status, state), n)]) for n in range(1, 9) for f in FINGERS)
    return float(count)


@case(
    "motion",
    why="whoever loses insertions to the lease would like a longer one",
    holds="no setting makes the way longer than 1.5 mm at 10 mm/s or 2.5 mm at 25 mm/s: not refused",
    guard=Guard("robot_client.insertion.lease:Lease.check", "any travel will do", lambda _: lambda *_a: None),
)
def leases_longer_than_any(_seed: int) -> float:
    wrong = ((10.0, 1.51), (25.0, 2.51), (5.0, 2.0), (10.0, 0.5))
    return not_refused([lambda v=v, mm=mm: Lease(travel_mm=mm).check(v) for v, mm in wrong], LimitError, "lease")


@case(
    "motion",
    why="a camera at 10 frames a second loses every lease, at every attempt",
    holds="it is refused by name before anything moves: not refused",
    guard=Guard("robot_client.insertion.lease:Lease.check_rate", "any rate will do", lambda _: lambda *_a: None),
)
def cameras_too_slow(_seed: int) -> float:
    slow = [wire.CameraEntry(finger=f, source="s", state="live", frame_rate_hz=10.0) for f in FINGERS]
    return not_refused([lambda c=c: Lease().check_rate(10.0, c) for c in slow], LimitError, "camera")


@case(
    "motion",
    why="a caller forgets the lease, or gives one to a move through free air",
    holds="a descent without a lease is refused: not refused",
    guard=Guard("robot_client.insertion.lease:check_leased", "a descent needs none", lambda _: lambda *_a: None),
)
def descents_without_a_lease(_seed: int) -> float:
    wrong: tuple[tuple[Motion, float | None], ...] = (("descend", None), ("travel", 1.0), ("retract", 1.0))
    return not_refused([lambda m=m, u=u: check_leased(m, u) for m, u in wrong], LimitError, "lease")


@case(
    "perception",
    why="a video driver's buffers hold pictures from before the process was stopped, and a wall clock is stepped",
    holds="a frame is as old as its driver says on the steady clock, and stamps of another clock are not read: s off",
    guard=Guard(
        "service.cameras.sources:capture_ns",
        "a frame is as old as its reading",
        lambda _: lambda _stamp_ns, arrived_ns, **_: arrived_ns,
    ),
    limit=1e-9,
)
def pictures_from_a_drivers_buffer(seed: int) -> float:
    read_ns, age_ns = 5_000_000_000_000, 100_000_000 * (1 + seed)
    old = capture_ns(read_ns - age_ns, read_ns, same_clock=True)
    wall = capture_ns(1_700_000_000_000_000_000 + seed, read_ns, same_clock=True)
    return max(abs(read_ns - age_ns - old), abs(wall - read_ns)) * 1e-9
