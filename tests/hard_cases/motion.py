"""Hard motion: rotations without a branch, clocks that jump, counters that wrap, moves of no length."""

import itertools
import math
from types import MappingProxyType

import numpy as np

from robot_client.codecs.egm import EgmError, Guidance, Pose, RobotState, decode_guidance, decode_robot, encode_guidance
from robot_client.codecs.wsg50 import Command, StreamParser, WsgError, encode_frame, encode_request
from robot_client.drivers.egm_watch import EgmWatch
from robot_client.events import Arrived, Begin, FromService, Grasped, Move, Standstill, Tick
from robot_client.geometry import CellFrame, WorkPose, multiply, normalised, yaw_quaternion
from robot_client.insertion import Phase, Plan, State, step
from robot_client.limits import LimitError, Limits, StepGuard, check_correction, check_pose
from robot_client.motion import CYCLE_S, MotionGuide, Ramps
from robot_client.profile import plan_profile
from robot_client.silence import Silence
from service.contract import wire
from tests.hard_cases.registry import case, non_finite, not_refused

GEOMETRY, LIMITS, MOTION = "robot_client/geometry.py", "robot_client/limits.py", "robot_client/motion.py"
WATCH, EGM, WSG = "robot_client/drivers/egm_watch.py", "robot_client/codecs/egm.py", "robot_client/codecs/wsg50.py"
BAD = (math.nan, math.inf, -math.inf)


def pose(x: float = 0.0, y: float = 0.0, z: float = 35.0, yaw: float = 0.0) -> WorkPose:
    """A pose of the tool in the work object."""
    return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw)


@case(
    "motion",
    why="a quaternion near 180 deg has w near 0, where a formula by acos or a division by w loses all digits",
    holds="pose -> controller -> pose is the identity at any yaw and any frame: mm or deg apart",
    guard=(GEOMETRY, "yaw_deg = math.degrees(2.0 * math.atan2(qz, qw))", "yaw_deg = math.degrees(2.0 * math.asin(qz))"),
    limit=1e-7,
)
def quaternions_near_half_a_turn(seed: int) -> float:
    rng = np.random.default_rng(seed)
    worst = 0.0
    for yaw in (179.9999999, 180.0, -180.0, 180.0000001, 90.0, 0.0, *rng.uniform(-180, 180, 30)):
        turn = normalised(tuple(rng.normal(size=4).tolist()))
        frame = CellFrame(origin_mm=(1000.0, -2000.0, 300.0), rotation=turn)
        start = pose(*rng.uniform(-40, 40, 3), yaw=float(yaw))
        back, tilt = frame.from_controller(frame.to_controller(start), near_yaw_deg=start.yaw_deg)
        worst = max(worst, start.distance_mm(back), start.turn_deg(back), abs(tilt) * 1e-2)
    return worst


@case(
    "motion",
    why="q and -q are one rotation; a controller may send either, and a yaw of 359 deg is one of -1",
    holds="both signs read as the same yaw, never a whole turn away: deg apart",
    guard=(GEOMETRY, "yaw_deg += 360.0 * round((near_yaw_deg - yaw_deg) / 360.0)", "yaw_deg += 0.0"),
    limit=1e-9,
)
def quaternions_of_either_sign(seed: int) -> float:
    frame, worst = CellFrame(), 0.0
    for yaw in np.random.default_rng(seed).uniform(-180, 180, 50):
        sent = frame.to_controller(pose(yaw=float(yaw)))
        turned = Pose(sent.x_mm, sent.y_mm, sent.z_mm, *(-value for value in sent.quaternion))
        read = [frame.from_controller(p, near_yaw_deg=float(yaw))[0].yaw_deg for p in (sent, turned)]
        worst = max(worst, abs(read[0] - read[1]), abs(read[0] - yaw))
    return worst


@case(
    "motion",
    why="a quaternion of length zero has no direction to normalise",
    holds="no rotation is refused, an ill-scaled one is made unit: not refused, | |q| - 1 |",
    guard=(GEOMETRY, "if not (math.isfinite(norm) and norm > 1e-9):", "if False:"),
    limit=1e-12,
)
def quaternions_of_no_length(_seed: int) -> float:
    missed = not_refused(
        [lambda q=q: normalised(q) for q in ((0.0,) * 4, (1e-12, 0, 0, 0), (math.nan, 0, 0, 1))], ValueError
    )
    long = normalised((1e150, 1e150, 0.0, 1e150))
    return max(missed, abs(math.hypot(*long) - 1))


@case(
    "motion",
    why="a chain of a million small turns drifts off the unit sphere",
    holds="after 100,000 products of small turns the norm is renormalised away: | |q| - 1 |",
    guard=(GEOMETRY, "return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)"),
    limit=1e-12,
    quick=False,
)
def long_chains_of_small_turns(seed: int) -> tuple[float, str]:
    turns = [yaw_quaternion(float(v)) for v in np.random.default_rng(seed).normal(0, 1, 100)]
    q = (1.0, 0.0, 0.0, 0.0)
    for index in range(100_000):
        q = multiply(q, turns[index % 100])
    return abs(math.hypot(*normalised(q)) - 1), f"before: {abs(math.hypot(*q) - 1):.1e}"


@case(
    "motion",
    why="a move of no length divides by its length",
    holds="it ends at once on its own start: distance, or cycles beyond 2",
    guard=(MOTION, "if self._profile.length > 0 else 1.0", "if True else 1.0"),
)
def moves_of_no_length(_seed: int) -> float:
    worst = 0.0
    for tiny in (0.0, 5e-324, 1e-12):
        guide, cycles = MotionGuide(Limits(), Ramps(), pose()), 0
        guide.move(pose(x=tiny), "travel")
        while guide.moving and cycles < 100:
            guide.advance(CYCLE_S)
            cycles += 1
        worst = max(worst, guide.target.distance_mm(pose(x=tiny)), cycles - 2.0)
    return worst


@case(
    "motion",
    why="the seven segments of a jerk-limited move degenerate one after the other as the way gets short",
    holds="position rises from 0 to its end without a step back: fall or overshoot relative to the way",
    guard=("robot_client/profile.py", "ramp_s = math.cbrt(length / (2.0 * jerk))", "ramp_s = acceleration / jerk"),
    limit=1e-9,
)
def ways_of_any_length(seed: int) -> float:
    rng = np.random.default_rng(seed)
    worst = 0.0
    for length, speed, acceleration, jerk in 10.0 ** rng.uniform([-9, -1, 0, 1], [3, 3, 4, 6], (200, 4)):
        profile = plan_profile(length, speed, acceleration, jerk)
        at = [profile.position(t) for t in np.linspace(0, profile.duration_s, 200)]
        worst = max(worst, float(-np.diff(at).min() / length), abs(at[-1] - length) / length, max(at) / length - 1)
    return worst


@case(
    "motion",
    why="a limit compared with NaN is never exceeded",
    holds="no target, correction or time step that is not finite passes: not refused",
    guard=(LIMITS, "if not (math.isfinite(value) and low <= value <= high):", "if value < low or value > high:"),
)
def targets_that_are_no_numbers(_seed: int) -> float:
    def target(name: str, value: float) -> WorkPose:
        return WorkPose.model_construct(**{"x_mm": 0.0, "y_mm": 0.0, "z_mm": 35.0, "yaw_deg": 0.0, name: value})

    fields = ("x_mm", "y_mm", "z_mm", "yaw_deg")
    calls = [lambda n=n, v=v: check_pose(Limits(), target(n, v)) for n, v in itertools.product(fields, BAD)]
    calls += [lambda v=v: check_correction(Limits(), 1, v, 0.0, 0.0) for v in BAD]
    calls += [lambda v=v: check_correction(Limits(), 1, 0.0, 0.0, v) for v in (math.nan, math.inf)]
    calls += [lambda v=v: StepGuard(Limits(), pose()).check(pose(x=1e-4), v, "travel") for v in (*BAD, 0.0, -1.0)]
    return not_refused(calls, LimitError)


@case(
    "motion",
    why="a message made elsewhere may carry NaN, and JSON may spell it",
    holds="a contract type or a message with a non-finite number is refused: not refused",
    guard=("service/contract/frames.py", "allow_inf_nan=False", "allow_inf_nan=True"),
)
def messages_with_numbers_that_are_none(_seed: int) -> float:
    calls = [lambda v=v: pose(x=v) for v in BAD]
    text = '{"type":"stopped","insertion_id":"a","attempt":1,"depth_mm":%s,"outcome":"blocked"}'
    calls += [lambda t=t: wire.parse_client(text % t) for t in ("NaN", "Infinity", "-Infinity", "1e999")]
    return not_refused(calls, ValueError)


@case(
    "motion",
    why="time may stand still or run backwards when a clock is set or a datagram is late",
    holds="the target does not move on a time step of 0 or less: mm moved",
    guard=(MOTION, "if self._profile is None or elapsed_s <= 0.0:", "if self._profile is None:"),
)
def time_going_backwards(_seed: int) -> float:
    guide = MotionGuide(Limits(), Ramps(), pose())
    guide.move(pose(z=10.0), "descend")
    for _ in range(50):
        guide.advance(CYCLE_S)
    before = guide.target
    for elapsed in (0.0, -0.004, -1e9):
        guide.advance(elapsed)
    return guide.target.distance_mm(before)


@case(
    "motion",
    why="a stream that gaps and stutters changes the apparent speed of every step",
    holds="no rhythm of cycles makes a move break its own limits or miss its end: refusals, mm off",
    guard=(MOTION, "self._walked_s += elapsed_s * (before + self._rate) / 2.0", "self._walked_s += elapsed_s * before"),
    limit=1e-9,
)
def streams_that_stutter(seed: int) -> float:
    rng = np.random.default_rng(seed)
    rhythms = [[40, 2, 13, 14, 1], *(rng.choice([0, 1, 2, 4, 8, 13, 14, 15, 40, 500], 12).tolist() for _ in range(20))]
    worst = 0.0
    for rhythm in rhythms:
        guide, end = MotionGuide(Limits(), Ramps(), pose(z=5.0)), pose(z=5.0, yaw=8.0)
        guide.move(end, "travel")
        for cycle_ms in itertools.islice(itertools.cycle([*rhythm, 4]), 4000):
            guide.advance(cycle_ms / 1e3)
        worst = max(worst, guide.target.turn_deg(end))
    return worst


@case(
    "motion",
    why="sequence numbers and the robot's clock are 32 bits and wrap in mid-insertion after 50 days",
    holds="elapsed time across the wrap is right, an old datagram stays refused: s off",
    guard=(
        WATCH,
        "elapsed_s = 0.0 if first else ((state.time_ms - self._robot_ms) % 2**32) / 1e3",
        "elapsed_s = 0.0 if first else (state.time_ms - self._robot_ms) / 1e3",
    ),
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
    why="a datagram is whatever somebody sent to the port",
    holds="random bytes decode or are refused by name, and nothing non-finite comes out: other endings",
    guard=(EGM, 'raise EgmError(f"{name} has a quaternion of norm {norm:.4f}, expected 1")', "pass"),
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
                found = decode(bytes(data))
            except EgmError:
                continue
            target = found.pose if isinstance(found, Guidance) else found.feedback
            wrong += 0.0 if target is None else non_finite(target.x_mm, target.y_mm, target.z_mm, *target.quaternion)
    return wrong


@case(
    "motion",
    why="a damaged length field may claim the bytes of the next frames",
    holds="every whole frame after garbage and damage is found: frames lost",
    guard=(WSG, "self.crc_errors += 1", "self._buffer.clear()"),
)
def gripper_frames_after_garbage(seed: int) -> float:
    rng = np.random.default_rng(seed)
    good = [encode_frame(0x40 + k, bytes(rng.integers(0, 256, k, dtype=np.uint8))) for k in range(12)]
    stream = b""
    for frame in good:
        damaged = bytearray(frame)
        damaged[-1] ^= 0x5A
        stream += bytes(damaged) + b"\xaa\xaa" + frame
    parser, found = StreamParser(), []
    while stream:
        cut = int(rng.integers(1, 40))
        found += parser.feed(stream[:cut])
        stream = stream[cut:]
    wanted = {frame[3] for frame in good}
    return float(len(wanted - {frame.command for frame in found}))


@case(
    "motion",
    why="a float32 field takes NaN and infinity without a word",
    holds="a gripper command with a non-finite number is refused: not refused",
    guard=(WSG, "def _pack(layout: str, values: tuple[Value, ...], name: str) -> bytes:"),
)
def gripper_commands_that_are_no_numbers(_seed: int) -> float:
    return not_refused([lambda v=v: encode_request(Command.GRASP, v, 30.0) for v in BAD], WsgError)


MESSAGES = MappingProxyType({"insertion_id": "t-1", "attempt": 1})


def deciding() -> State:
    """The state machine with the arm at rest, waiting for a correction."""
    plan = Plan(insertion_id="t-1", approach=pose(x=8.0, yaw=6.0), gap_width_mm=56.0, expected_depth_mm=25.0)
    limits = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)
    hello = wire.ServiceHello(insertion_id="t-1", models=(), cameras=(), controller="belief", limits=limits)
    at_height, above = plan.approach, plan.approach.at_height(60.0)
    story = [
        Begin(at_s=0.0, pose=pose(z=60.0)),
        FromService(at_s=0.1, message=hello),
        Grasped(at_s=0.2, width_mm=80.0),
        *(Arrived(at_s=0.3, pose=there) for there in (pose(z=60.0), above, at_height)),
        FromService(at_s=0.4, message=wire.Armed(**MESSAGES, reference_seq=3)),
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
    guard=("robot_client/insertion.py", "if message.attempt < state.attempt:", "if False:"),
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


@case(
    "motion",
    why="a clock that jumps makes every deadline pass at once, or never",
    holds="a tick at any time ends in a hold or nothing, never in a move: moves",
    guard=("robot_client/insertion.py", "if event.at_s < state.deadline_s:"),
)
def ticks_at_impossible_times(_seed: int) -> float:
    state = deciding()
    moves = 0
    for at_s in (-1e18, -1.0, 0.0, 1e3, 1e18, 1e300):
        _, commands = step(state, Tick(at_s=at_s))
        moves += any(isinstance(command, Move) for command in commands)
    return float(moves)
