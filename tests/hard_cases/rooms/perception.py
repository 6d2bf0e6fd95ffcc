"""Hard frames: jumps, misleading light, no markers at all, fingers that vanish."""

from collections.abc import Callable

import cv2
import numpy as np

from service.contract import Sensor
from service.perception.markers.detect import Candidates
from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import CameraCalibration, Rectifier
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.onset import OnsetDetector
from tests.hard_cases.instead import with_globals
from tests.hard_cases.registry import Guard, case, non_finite, not_refused
from tests.service.perception.synthetic import FRAME_NS, draw, grid, hard_image, twist

SENSOR = Sensor.load()

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


def _elsewhere(field: MarkerField, truth: np.ndarray) -> float:
    """Share of markers that are valid, and not within a pixel of the truth."""
    error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
    return float((field.valid & (error >= 1.0)).mean())


def _lost(field: MarkerField, truth: np.ndarray, within_px: float) -> float:
    """Share of markers that are not valid and within ``within_px`` of the truth."""
    error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
    return 1.0 - float((field.valid & (error < within_px)).mean())


def as_at_first(_bright_enough: object) -> Callable[[MarkerTracker, Candidates], Candidates]:
    """A spot's strength is compared with that of the first frame's markers."""
    return lambda tracker, spots: spots.only(spots.strength > 0.3 * float(np.median(tracker._lattice.strength)))


def without_memory(update: Callable[..., MarkerField]) -> Callable[..., MarkerField]:
    """The tracker forgets when its last frame was taken."""

    def updated(tracker: MarkerTracker, image: np.ndarray | None, captured_ns: int) -> MarkerField:
        tracker._last_ns = None
        return update(tracker, image, captured_ns)

    return updated


@case(
    "perception",
    why="the nearest blob to a marker that moved 0.9 pitch is its neighbour",
    holds="after a jump of 0.9 pitch markers keep their identity: share lost",
    guard=Guard(
        "service.perception.markers.matching:reindex",
        "a marker is the nearest spot",
        lambda _: lambda *arguments: arguments[5],
    ),
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


def _frame_case(name: str, why: str, guard: Guard, truth: np.ndarray | None = None, *, quick: bool = False) -> None:
    """A frame without usable content: results are finite, nothing is tracked but ``truth``, and the grid returns."""

    def measure(seed: int) -> float:
        rng = np.random.default_rng(seed + 50)
        hard = hard_image(name, np.random.default_rng(seed))
        first, bad = _watched([hard], seed)
        if truth is None:
            bad += float(first.status != "lost")
        else:
            bad += _elsewhere(first, truth) + float(first.status == "lost")
        field, more = _watched([hard, hard, draw(REST, rng), draw(REST, rng)], seed)
        return max(bad + more, _lost(field, REST, 1.0) - 0.03)

    measure.__name__ = f"frame_{name}"
    what = "is lost" if truth is None else "is tracked only where markers are"
    case(
        "perception",
        why=why,
        holds=f"it {what}, nothing is non-finite, 97 % of the markers are back two frames later: excess",
        guard=guard,
        quick=quick,
    )(measure)


TRACKER = "service.perception.markers.tracker:"
AS_BEFORE = Guard(
    f"{TRACKER}MarkerTracker._lost",
    "the field before stays in force",
    lambda _: lambda tracker, captured_ns, why: tracker._stale(captured_ns, "duplicate", why),
)
TOO_FEW = Guard(f"{TRACKER}MarkerTracker._track", "any number of markers is enough", with_globals(len=lambda _: 99))
NO_GRID = Guard(f"{TRACKER}_RANDOM", "spots may lie as they like", np.inf)
HALF = Guard(f"{TRACKER}TrackerSettings", "half of a grid is no grid", lambda usual: lambda: usual(lost_share=0.6))

_frame_case("black", "no marker has any contrast, and contrast is a divisor", TOO_FEW, quick=True)
_frame_case("white", "every pixel is clipped: there is no gradient anywhere", AS_BEFORE)
_frame_case("noise", "thousands of blobs, none a marker", NO_GRID, quick=True)
_frame_case("covered", "half the markers are gone at once", HALF, REST)
_frame_case("line", "a single row of markers determines no grid", AS_BEFORE)
_frame_case("three", "three markers are fewer than a fit needs", AS_BEFORE)
_frame_case("scattered", "400 dots in no order offer a wrong partner to every marker", NO_GRID)


@case(
    "perception",
    why="among hundreds of blobs some lie as if they were the nodes of a small grid",
    holds="pictures of noise, blurred or not, and of strewn dots contain no grid: grids found in 12",
    guard=Guard(
        "service.perception.markers.lattice:_strewn", "spots may lie as they like", lambda _: lambda _grid: False
    ),
)
def first_frames_without_a_grid(seed: int) -> float:
    rng = np.random.default_rng(seed)
    blurred = [
        cv2.GaussianBlur(rng.integers(0, 256, (320, 327)).astype(np.float32), (0, 0), px) for px in (1, 2, 4) * 2
    ]
    images = [cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8) for image in blurred]
    images += [hard_image(name, rng) for name in ("noise", "scattered") * 3]
    return float(sum(MarkerTracker().update(image, 0).status != "no_grid" for image in images))


@case(
    "perception",
    why="a camera that is unplugged delivers nothing, and its finger must not look like one at rest",
    holds="a missing frame is the typed state lost, finite, and the next frame is tracked: numbers wrong",
    guard=AS_BEFORE,
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
    holds="markers stay where they are when the light changes by factors of 0.25 and 1.5: px RMS of a component",
    guard=Guard(f"{TRACKER}MarkerTracker._bright_enough", "a marker is as strong as in the first frame", as_at_first),
    limit=0.15,
    quick=False,
)
def exposures_that_jump(seed: int) -> float:
    rng = np.random.default_rng(seed)
    tracker, worst = MarkerTracker(), 0.0
    for k, light in enumerate((140.0, 35.0, 210.0, 140.0)):
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
