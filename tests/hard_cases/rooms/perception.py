"""Hard frames and fields: fits without a solution, twists, jumps, misleading light, fingers that vanish."""

from collections.abc import Callable

import numpy as np

from service.contract import Sensor
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import CameraCalibration, Rectifier
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.rigid import fit_motion
from tests.hard_cases.instead import like, with_globals
from tests.hard_cases.registry import Guard, case, non_finite, not_refused
from tests.service.perception.synthetic import FRAME_NS, draw, grid, hard_image, patch_fields, rigid, twist

SENSOR = Sensor.load()

TOO_FEW = "service.perception.markers.tracker:MarkerTracker._track"
TOO_LITTLE = "service.perception.markers.tracker:TrackerSettings.lost_share"
SUSPICION = "service.perception.markers.matching:reindex"
OWN_LIGHT = "service.perception.markers.tracker:MarkerTracker._bright_enough"
REST = grid()
PITCH = 15.0


def _finite(field: MarkerField, *states: object) -> float:
    """How many numbers of a field and of slip states are not finite."""
    counted = non_finite(field.displacement_px, field.rest_px)
    for state in states:
        counted += non_finite(state.residual_px, state.score, state.angle_rad, state.scale, *state.shift_px)
    return counted


def _watched(images: list[object], seed: int) -> tuple[MarkerField, float]:
    """Every consumer over a healthy frame, then ``images``: the last field, and how many numbers were not finite."""
    rng = np.random.default_rng(seed)
    tracker, slip, onset, watch = MarkerTracker(), SlipDetector(), OnsetDetector(), GraspWatch()
    field = tracker.update(draw(REST, rng), 0)
    slip.rearm(field)
    onset.rearm(field)
    bad = 0.0
    for k, image in enumerate(images, 1):
        field = tracker.update(image, k * FRAME_NS)
        onset.update(field)
        bad += _finite(field, slip.update(field), watch.update(field))
    return field, bad


def _lost(field: MarkerField, truth: np.ndarray, within_px: float) -> float:
    """Share of markers that are not valid and within ``within_px`` of the truth."""
    error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
    return 1.0 - float((field.valid & (error < within_px)).mean())


def without_memory(update: Callable[..., MarkerField]) -> Callable[..., MarkerField]:
    """The tracker forgets when its last frame was taken."""

    def updated(tracker: MarkerTracker, image: np.ndarray | None, captured_ns: int) -> MarkerField:
        tracker._last_ns = None
        return update(tracker, image, captured_ns)

    return updated


@case(
    "perception",
    why="a rotation is not determined by points on one line: the normal equations are singular",
    holds="collinear, coincident and fewer than four markers give no motion: fits returned",
    guard=Guard("service.perception.slip.rigid:MIN_SPREAD", "points on a line are enough", 0.0),
)
def rigid_fits_without_a_solution(seed: int) -> tuple[float, str]:
    rng = np.random.default_rng(seed)
    line = np.stack([np.linspace(0, 300, 20), np.full(20, 160.0)], -1)
    sets = [
        line,
        line + rng.normal(0, 0.5, line.shape),
        np.tile([[160.0, 160.0]], (20, 1)),
        rng.uniform(0, 300, (3, 2)),
        line[:0],
    ]
    given = sum(fit_motion(p, p + 1, np.ones(len(p)), PITCH, scale=s) is not None for p in sets for s in (True, False))
    nearly = line + rng.normal(0, 0.5, line.shape)
    spread = np.linalg.eigvalsh(np.cov(nearly.T))
    condition = f"condition {spread[1] / spread[0]:.0e} on the nearly straight line"
    return float(given), f"{condition}: refused below 0.3 pitch across"


@case(
    "perception",
    why="weights of zero leave no points, and their mean is 0/0",
    holds="zero weight gives no motion: fits returned",
    guard="service.perception.slip.rigid:MIN_NODES",
)
def rigid_fits_without_weight(seed: int) -> float:
    points = np.random.default_rng(seed).uniform(0, 300, (30, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        motions = [fit_motion(points, points, w, PITCH, scale=True) for w in (np.zeros(30), np.eye(30)[0])]
    return float(sum(motion is not None for motion in motions))


@case(
    "perception",
    why="small-angle formulas call a rotation a slip: 1 - cos 40 deg is a quarter of a pitch at the rim",
    holds="an exact rotation of any angle is found: deg or px off",
    guard=Guard(
        "service.perception.slip.rigid:fit_motion",
        "the angle is its tangent",
        with_globals(np=like(np, arctan2=np.divide)),
    ),
    limit=1e-6,
)
def rotations_of_any_angle(seed: int) -> float:
    rng, worst = np.random.default_rng(seed), 0.0
    for degrees in (1e-6, 5.0, 45.0, 90.0, 179.0, -120.0):
        points = rng.uniform(0, 300, (60, 2))
        turned = twist(points, degrees, shift=(3.0, -2.0))
        motion = fit_motion(points, turned, np.ones(60), PITCH, scale=False)
        off_px = float(np.abs(motion.apply(points) - turned).max())
        worst = max(worst, abs(np.rad2deg(motion.angle_rad) - degrees), off_px)
    return worst


@case(
    "perception",
    why="differences of numbers near 1e8 lose their digits if they are not centred first",
    holds="a fit far from the origin equals one at the origin: deg apart",
    guard="service.perception.slip.rigid:fit_motion",
    limit=1e-4,
)
def rotations_far_from_the_origin(seed: int) -> float:
    points = np.random.default_rng(seed).uniform(0, 300, (60, 2))
    turns_deg = []
    for offset in (0.0, 1e6):
        before, after = points + offset, twist(points, 7.0) + offset
        turns_deg.append(np.rad2deg(fit_motion(before, after, np.ones(60), PITCH, scale=False).angle_rad))
    return abs(float(turns_deg[0] - turns_deg[1]))


@case(
    "perception",
    why="a rotating patch carries its rim further than any slip threshold",
    holds="a twist to 60 deg at 5 deg per frame is never reported as slip: frames that are",
    guard="service.perception.slip.state:SlipSettings.slip_pitch",
    quick=False,
)
def twists_of_sixty_degrees(seed: int) -> float:
    (first, *others), _ = patch_fields(rigid(degrees=5.0), frames=13, seed=seed)
    slip = SlipDetector()
    slip.rearm(first)
    return float(sum(slip.update(field).state == "incipient_slip" for field in others))


@case(
    "perception",
    why="the nearest blob to a marker that moved 0.9 pitch is its neighbour",
    holds="after a jump of 0.9 pitch markers keep their identity: share lost",
    guard=SUSPICION,
    limit=0.01,
    quick=False,
)
def jumps_of_almost_a_pitch(seed: int) -> float:
    rng, worst = np.random.default_rng(seed), 0.0
    for angle in np.deg2rad([0, 30, 45, 90, 200]):
        tracker = MarkerTracker()
        tracker.update(draw(REST, rng), 0)
        moved = REST + 0.9 * PITCH * np.array([np.cos(angle), np.sin(angle)])
        field = tracker.update(draw(moved, rng), FRAME_NS)
        inside = (moved > 4).all(-1) & (moved < (322, 315)).all(-1)
        error = np.linalg.norm(field.rest_px + field.displacement_px - moved, axis=-1)
        worst = max(worst, 1.0 - float((field.valid & (error < 3.0))[inside].mean()))
    return worst


def _frame_case(name: str, why: str, guard: str, *, quick: bool = False) -> None:
    """A frame without usable content: every result is finite and typed, and the grid returns after it."""

    def measure(seed: int) -> float:
        rng = np.random.default_rng(seed + 50)
        hard = hard_image(name, np.random.default_rng(seed))
        field, bad = _watched([hard, hard, draw(REST, rng), draw(REST, rng)], seed)
        return max(bad, _lost(field, REST, 1.0) - 0.03)

    measure.__name__ = f"frame_{name}"
    case(
        "perception",
        why=why,
        holds="nothing raised, nothing non-finite, 97 % of the markers back two frames later: excess",
        guard=guard,
        quick=quick,
    )(measure)


_frame_case("black", "no marker has any contrast, and contrast is a divisor", TOO_FEW, quick=True)
_frame_case("white", "every pixel is clipped: there is no gradient anywhere", TOO_FEW)
_frame_case("saturated", "half the picture is clipped and the other half is not", OWN_LIGHT)
_frame_case("noise", "thousands of blobs, none a marker", SUSPICION)
_frame_case("covered", "half the markers are gone at once", TOO_LITTLE)
_frame_case("line", "a single row of markers determines no grid", TOO_LITTLE)
_frame_case("three", "three markers are fewer than a fit needs", TOO_FEW)
_frame_case("scattered", "400 dots in no order offer a wrong partner to every marker", SUSPICION)
_frame_case("twist", "45 deg in one frame moves the rim by seven pitches", SUSPICION)


@case(
    "perception",
    why="a camera that is unplugged delivers nothing, and its finger must not look like one at rest",
    holds="a missing frame is the typed state lost, finite, and the next frame is tracked: numbers wrong",
    guard="service.perception.markers.tracker:MarkerTracker._lost",
)
def fingers_that_vanish(seed: int) -> float:
    rng = np.random.default_rng(seed)
    tracker, slip = MarkerTracker(), SlipDetector()
    slip.rearm(tracker.update(draw(REST, rng), 0))
    gone = tracker.update(None, FRAME_NS)
    state = slip.update(gone)
    back = tracker.update(draw(REST, rng), 2 * FRAME_NS)
    wrong = float(state.state not in {"lost", "unknown"}) + float(back.status != "tracking")
    return wrong + _finite(gone, state)


@case(
    "perception",
    why="a driver may repeat a frame with an old stamp, or its clock may jump",
    holds="a frame that is not newer is a duplicate and no evidence: frames taken as new",
    guard=Guard(
        "service.perception.markers.tracker:MarkerTracker.update", "the last stamp is forgotten", without_memory
    ),
)
def clocks_that_jump(seed: int) -> float:
    rng = np.random.default_rng(seed)
    tracker, slip = MarkerTracker(), SlipDetector()
    slip.rearm(tracker.update(draw(REST, rng), 10 * FRAME_NS))
    wrong = 0
    for stamp_ns in (9 * FRAME_NS, 10 * FRAME_NS, -(2**62)):
        field = tracker.update(draw(twist(REST, 3), rng), stamp_ns)
        wrong += field.status != "duplicate" or slip.update(field).state != "hold"
    return float(wrong + (tracker.update(draw(REST, rng), 2**62).status != "tracking"))


@case(
    "perception",
    why="an exposure step changes every grey level at once and nothing else",
    holds="markers stay where they are when the light changes by factors of 0.6 and 1.5: px RMS of a component",
    guard=OWN_LIGHT,
    limit=0.15,
    quick=False,
)
def exposures_that_jump(seed: int) -> float:
    rng = np.random.default_rng(seed)
    tracker, worst = MarkerTracker(), 0.0
    for k, light in enumerate((140.0, 84.0, 210.0, 140.0)):
        field = tracker.update(draw(REST, rng, light=light), k * FRAME_NS)
        off = (field.rest_px + field.displacement_px - REST)[field.valid]
        worst = max(worst, float(np.sqrt(np.square(off).mean())), float(field.valid.mean() < 0.97))
    return worst


@case(
    "perception",
    why="a homography that shrinks a side to nothing asks for pixels far outside the frame",
    holds="a rectified frame is whole and black outside the raw one, a wrong size is refused: not refused",
    guard=Guard(
        "service.contract.frames:FrameSpec.check", "a frame of any size passes", lambda _: lambda _spec, pixels: pixels
    ),
)
def raw_frames_of_another_size(seed: int) -> float:
    homography = np.array([[1.0, 0.05, -40.0], [0.02, 1.0, 5.0], [1e-4, 1e-5, 1.0]])
    rectifier = Rectifier(CameraCalibration(homography, SENSOR.raw, SENSOR.rectified))
    rng = np.random.default_rng(seed)
    shapes = [(320, 426, 3), (321, 427, 3), (320, 427), (0, 0, 3)]
    calls = [lambda s=s: rectifier.apply(rng.integers(0, 256, s, dtype=np.uint8)) for s in shapes]
    missed = not_refused(calls, ValueError)
    whole = rectifier.apply(np.full((320, 427, 3), 200, np.uint8))
    return missed + float(whole.shape != (320, 327, 3))
