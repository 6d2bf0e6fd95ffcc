"""Hard links: counters that wrap, datagrams and frames of garbage, messages out of their time."""

import math
from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from robot_client.grippers.wsg50.codec import StreamParser, WsgError, encode_frame, encode_request
from robot_client.grippers.wsg50.codes import Command
from robot_client.insertion.events import Arrived, Begin, FromService, Grasped, Move, Standstill, Tick
from robot_client.insertion.geometry import Pose
from robot_client.insertion.machine import Phase, Plan, Result, State, step
from robot_client.insertion.motion import Ramp, Ramps
from robot_client.robots.abb_egm.codec import (
    EgmError,
    Guidance,
    RobotState,
    decode_guidance,
    decode_robot,
    encode_guidance,
)
from robot_client.robots.abb_egm.watch import EgmWatch
from robot_client.silence import Silence
from service.contract import wire
from tests.hard_cases.instead import blind
from tests.hard_cases.registry import Guard, case, non_finite, not_refused
from tests.hard_cases.rooms.motion import BAD, pose


def never_wrapping(take: Callable[..., float | None]) -> Callable[..., float | None]:
    """A robot's clock that shows less than before has not moved."""

    def taken(watch: EgmWatch, state: RobotState, now_s: float) -> float | None:
        before_ms = watch._robot_ms
        elapsed_s = take(watch, state, now_s)
        return elapsed_s if elapsed_s is None or state.time_ms >= before_ms else 0.0

    return taken


def of_this_attempt(handle: Callable[..., Result]) -> Callable[..., Result]:
    """A message of an older attempt is taken for one of the attempt under way."""

    def handled(state: State, message: wire.Correction, at_s: float) -> Result:
        attempt = max(message.attempt, state.attempt)
        return handle(state, message.model_copy(update={"attempt": attempt}), at_s)

    return handled


@case(
    "motion",
    why="sequence numbers and the robot's clock are 32 bits and wrap in mid-insertion after 50 days",
    holds="elapsed time across the wrap is right, an old datagram stays refused: s off",
    guard=Guard("robot_client.robots.abb_egm.watch:EgmWatch.take", "a clock that wraps stands still", never_wrapping),
    limit=1e-12,
)
def counters_wrapping_round(_seed: int) -> float:
    watch = EgmWatch(Silence(0.25, 0.05), 0.25)
    watch.take(RobotState(2**32 - 1, 2**32 - 2, Pose(0, 0, 0)), 0.0)
    late = watch.take(RobotState(2**32 - 3, 2**32 - 10, Pose(0, 0, 0)), 0.002)
    elapsed = watch.take(RobotState(0, 2, Pose(0, 0, 0)), 0.004)
    return math.inf if late is not None or elapsed is None else abs(elapsed - 0.004)


@case(
    "motion",
    why="a datagram may be anything that somebody sends to the port",
    holds="random bytes decode or are refused by name, and nothing non-finite comes out: other endings",
    guard=Guard(
        "robot_client.insertion.geometry:Pose.check",
        "any four numbers are a rotation",
        lambda _: lambda pose, *_: pose,
    ),
)
def datagrams_of_random_bytes(seed: int) -> float:
    rng = np.random.default_rng(seed)
    whole = encode_guidance(Guidance(1, 4, Pose(1, 2, 3)))
    wrong = not_refused([lambda: encode_guidance(Guidance(1, 4, Pose(0, 0, 0, qw=2.0)))], EgmError)
    for _ in range(300):
        data = bytearray(whole if rng.random() < 0.7 else rng.bytes(int(rng.integers(0, 80))))
        for place in rng.integers(0, max(1, len(data)), 3):
            if data:
                data[place] = int(rng.integers(256))
        for decode in (decode_guidance, decode_robot):
            try:
                decoded = decode(bytes(data))
            except EgmError:
                continue
            target = decoded.pose if isinstance(decoded, Guidance) else decoded.feedback
            wrong += 0.0 if target is None else non_finite(target.x_mm, target.y_mm, target.z_mm, *target.quaternion)
    return wrong


@case(
    "motion",
    why="a damaged length field may claim the bytes of the next frames",
    holds="every whole frame after garbage and damage is found: frames lost",
    guard=Guard(
        "robot_client.grippers.wsg50.codec:StreamParser._skip",
        "64 bytes are dropped where one would do",
        lambda skip: lambda parser, count: skip(parser, 64 if count == 1 else count),
    ),
)
def gripper_frames_after_garbage(seed: int) -> float:
    rng = np.random.default_rng(seed)
    good = [encode_frame(0x40 + k, bytes(rng.integers(0, 256, k, dtype=np.uint8))) for k in range(12)]
    stream = b""
    for frame in good:
        damaged = bytearray(frame)
        damaged[-1] ^= 0x5A
        stream += bytes(damaged) + b"\xaa\xaa" + frame
    parser, frames = StreamParser(), []
    while stream:
        cut = int(rng.integers(1, 40))
        frames += parser.feed(stream[:cut])
        stream = stream[cut:]
    wanted = {frame[3] for frame in good}
    return float(len(wanted - {frame.command for frame in frames}))


@case(
    "motion",
    why="a float32 field accepts NaN and infinity silently",
    holds="a gripper command with a non-finite number is refused: not refused",
    guard=Guard("robot_client.grippers.wsg50.codec:_pack", "every number counts as finite", blind),
)
def gripper_commands_that_are_no_numbers(_seed: int) -> float:
    return not_refused([lambda v=v: encode_request(Command.GRASP, v, 30.0) for v in BAD], WsgError)


CLOCK = wire.Clock(sent_ns=0, service_ns=0)
MESSAGES = MappingProxyType({"insertion_id": "t-1", "attempt": 1})


def deciding() -> State:
    """The state machine with the arm at rest, waiting for a correction."""
    ramps = Ramps(descend=Ramp(speed_mm_s=10.0, acceleration_mm_s2=100.0, jerk_mm_s3=2000.0))
    start = pose(x=8.0, yaw=6.0)
    plan = Plan(insertion_id="t-1", approach=start, gap_width_mm=56.0, expected_depth_mm=25.0, ramps=ramps)
    limits = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)
    hello = wire.ServiceHello(
        insertion_id="t-1", models=(), cameras=(), controller="belief", limits=limits, clock=CLOCK
    )
    at_height, above = plan.approach, plan.approach.at_height(60.0)
    story = [
        Begin(at_s=0.0, pose=pose(z=60.0), held=True),
        FromService(at_s=0.1, message=hello),
        Grasped(at_s=0.2, width_mm=80.0),
        *(Arrived(at_s=0.3, pose=there) for there in (pose(z=60.0), above, at_height)),
        FromService(at_s=0.4, message=wire.Armed(**MESSAGES, reference_seq=3, frame_captured_ns=400_000_000)),
        FromService(
            at_s=0.9,
            message=wire.Slip(**MESSAGES, finger="left", frame_seq=9, captured_ns=1, age_ms=4.0, score=2.0, reason="r"),
        ),
        Standstill(at_s=1.0, pose=at_height.at_height(29.0)),
    ]
    state = State(plan)
    for event in story:
        state, _ = step(state, event)
    return state


@case(
    "motion",
    why="a correction may come twice, late, for another attempt, or not be a number",
    holds="no such correction moves the arm; only the right one does, once: wrong moves",
    guard=Guard(
        "robot_client.insertion.machine:_on_attempt_message",
        "a late message counts as one of this attempt",
        of_this_attempt,
    ),
)
def corrections_that_are_stale_or_absurd(_seed: int) -> float:
    state = deciding()
    if state.phase is not Phase.DECIDING:
        return math.inf

    def correction(attempt: int, dx: float) -> FromService:
        fields = {"insertion_id": "t-1", "attempt": attempt, "dx_mm": dx, "dtheta_deg": 1.0}
        message = wire.Correction.model_construct(type="correction", **fields)
        return FromService.model_construct(kind="from_service", at_s=1.1, message=message)

    wrong = 0
    for attempt, dx in ((1, math.nan), (1, math.inf), (1, 17.0), (0, 1.0), (2, 1.0)):
        _, commands = step(state, correction(attempt, dx))
        wrong += any(isinstance(command, Move) for command in commands)
    moved, first = step(state, correction(1, -3.0))
    _, second = step(moved, correction(1, -3.0))
    wrong += not any(isinstance(command, Move) for command in first)
    wrong += any(isinstance(command, Move) for command in second)
    return float(wrong)


def lifts_when_due(_on_tick: object) -> Callable[[State, Tick], Result]:
    """A deadline that has passed ends in a retraction."""

    def lifted(state: State, tick: Tick) -> Result:
        lift = Move(target=state.plan.approach, motion="retract")
        return state, (lift,) if tick.at_s >= state.deadline_s else ()

    return lifted


@case(
    "motion",
    why="a clock that jumps makes every deadline pass at once, or never",
    holds="a tick at any time ends in a hold or nothing, never in a move: moves",
    guard=Guard("robot_client.insertion.machine:_on_tick", "the arm lifts the object when time is up", lifts_when_due),
)
def ticks_at_impossible_times(_seed: int) -> float:
    state = deciding()
    moves = 0
    for at_s in (-1e18, -1.0, 0.0, 1e3, 1e18, 1e300):
        _, commands = step(state, Tick(at_s=at_s))
        moves += any(isinstance(command, Move) for command in commands)
    return float(moves)
