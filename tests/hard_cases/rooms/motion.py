"""Hard motion: rotations without a branch, clocks that jump, counters that wrap, moves of no length."""

import itertools
import math
from collections.abc import Callable

import numpy as np

from robot_client.insertion.geometry import CellFrame, Pose, WorkPose, multiply, normalised, turn_quaternion
from robot_client.insertion.limits import LimitError, Limits, StepGuard, check_correction, check_pose
from robot_client.insertion.motion import CYCLE_S, MotionGuide, Ramps
from robot_client.insertion.profile import plan_profile
from service.contract import wire
from service.contract.frames import Contract
from tests.hard_cases.instead import like, with_globals
from tests.hard_cases.registry import Guard, case, not_refused

BAD = (math.nan, math.inf, -math.inf)


def pose(x: float = 0.0, y: float = 0.0, z: float = 35.0, yaw: float = 0.0) -> WorkPose:
    """A pose of the tool in the work object."""
    return WorkPose(x_mm=x, y_mm=y, z_mm=z, yaw_deg=yaw)


def arc_sine(opposite: float, _adjacent: float) -> float:
    """Half of an angle from one side alone."""
    return math.asin(max(-1.0, min(1.0, opposite)))


def divided_by_the_way(advance: Callable[..., WorkPose]) -> Callable[..., WorkPose]:
    """Shares are taken of a path of any length."""

    def advanced(guide: MotionGuide, elapsed_s: float) -> WorkPose:
        assert not guide.moving or 1.0 / guide._profile.length
        return advance(guide, elapsed_s)

    return advanced


def outside_alone(_check: object) -> Callable[..., WorkPose]:
    """A pose is refused where a value compares as outside, which NaN does with no bound."""

    def check(limits: Limits, pose: WorkPose, name: str = "target") -> WorkPose:
        for field, value in pose.model_dump().items():
            low, high = getattr(limits, field)
            if value < low or value > high:
                raise LimitError(f"{name} {field}")
        return pose

    return check


def any_number(contract: type[Contract]) -> type[Contract]:
    """Every contract type, including messages, gets non-finite numbers."""
    for part in contract.__subclasses__():
        part.model_config["allow_inf_nan"] = True
        part.model_rebuild(force=True)
        any_number(part)
    wire._CLIENT.rebuild(force=True)
    return contract


@case(
    "motion",
    why="a quaternion near 180 deg has w near 0, where a formula by acos or a division by w loses all digits",
    holds="pose -> controller -> pose is the identity at any yaw and any frame: mm or deg apart",
    guard=Guard(
        "robot_client.insertion.geometry:CellFrame.from_controller",
        "angles come from an arc sine",
        with_globals(math=like(math, atan2=arc_sine)),
    ),
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
    guard=Guard(
        "robot_client.insertion.geometry:CellFrame.from_controller",
        "yaw is not unwrapped near the last one",
        with_globals(round=lambda _: 0),
    ),
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
    guard=Guard(
        "robot_client.insertion.geometry:normalised",
        "a quaternion of no length is kept",
        lambda _: lambda q: tuple(v / (math.hypot(*q) or 1.0) for v in q),
    ),
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
    guard=Guard("robot_client.insertion.geometry:normalised", "the norm drifts", lambda _: lambda turn: turn),
    limit=1e-15,
    quick=False,
)
def long_chains_of_small_turns(seed: int) -> tuple[float, str]:
    turns = [turn_quaternion(float(v)) for v in np.random.default_rng(seed).normal(0, 1, 100)]
    q = (1.0, 0.0, 0.0, 0.0)
    for index in range(100_000):
        q = multiply(q, turns[index % 100])
    return abs(math.hypot(*normalised(q)) - 1), f"before: {abs(math.hypot(*q) - 1):.1e}"


@case(
    "motion",
    why="a move of zero length divides by its length",
    holds="it ends at once at its own start: distance, or cycles beyond 2",
    guard=Guard("robot_client.insertion.motion:MotionGuide.advance", "the distance is a divisor", divided_by_the_way),
)
def moves_of_no_length(_seed: int) -> float:
    worst = 0.0
    for tiny in (0.0, 5e-324, 1e-12):
        guide, cycles = MotionGuide(Limits(), Ramps(), pose()), 0
        guide.move(pose(x=tiny), "travel")
        while guide.moving and cycles < 100:
            guide.advance(CYCLE_S, 0.0)
            cycles += 1
        worst = max(worst, guide.target.distance_mm(pose(x=tiny)), cycles - 2.0)
    return worst


@case(
    "motion",
    why="the seven segments of a jerk-limited move degenerate one after the other as the distance shrinks",
    holds="position rises monotonically from 0 to its end: fall or overshoot relative to the distance",
    guard=Guard(
        "robot_client.insertion.profile:plan_profile",
        "the wrong root for the shortest distances",
        with_globals(math=like(math, cbrt=math.sqrt)),
    ),
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
    guard=Guard(
        "robot_client.insertion.limits:check_pose", "only values that compare as outside are refused", outside_alone
    ),
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
    why="a message from other software may carry NaN, and JSON may spell it",
    holds="a contract type or a message with a non-finite number is refused: not refused",
    guard=Guard("service.contract.frames:Contract", "contract types accept any number", any_number),
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
    guard=Guard(
        "robot_client.insertion.motion:MotionGuide.advance",
        "a step back in time counts as a step forwards",
        lambda advance: lambda guide, elapsed_s: advance(guide, abs(elapsed_s)),
    ),
)
def time_going_backwards(_seed: int) -> float:
    guide = MotionGuide(Limits(), Ramps(), pose())
    guide.move(pose(z=10.0), "descend", 1e9)
    for _ in range(50):
        guide.advance(CYCLE_S, 0.0)
    before = guide.target
    for elapsed in (0.0, -0.004, -1e9):
        guide.advance(elapsed, 0.0)
    return guide.target.distance_mm(before)


@case(
    "motion",
    why="a stream with gaps and jitter changes the apparent speed of every step",
    holds="no rhythm of cycles makes a move break its own limits or miss its end: refusals, mm off",
    guard=Guard(
        "robot_client.insertion.motion:MotionGuide._resumes_in_s",
        "full speed at once after a gap",
        lambda _: lambda _guide, _fastest: 1e-9,
    ),
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
            guide.advance(cycle_ms / 1e3, 0.0)
        worst = max(worst, guide.target.turn_deg(end))
    return worst
