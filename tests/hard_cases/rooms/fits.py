"""Hard rigid motions: fits without a solution, large angles, points far from the origin."""

from collections.abc import Callable

import numpy as np

from service.perception.slip.detector import SlipDetector
from service.perception.slip.rigid import Motion, fit_motion
from tests.hard_cases.instead import like, with_globals
from tests.hard_cases.registry import Guard, case
from tests.service.perception.synthetic import patch_fields, rigid, twist

PITCH = 15.0
TANGENT = Guard(
    "service.perception.slip.rigid:fit_motion", "the angle is its tangent", with_globals(np=like(np, arctan2=np.divide))
)


def of_floats(fit: Callable[..., Motion | None]) -> Callable[..., Motion | None]:
    """The fit takes points in single precision."""
    return lambda before, after, *rest, **options: fit(np.float32(before), np.float32(after), *rest, **options)


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
    why="weights of zero leave no points, whose mean is 0/0, or three, through which any motion goes",
    holds="weight on three points or fewer gives no motion: fits returned",
    guard=Guard("service.perception.slip.rigid:MIN_NODES", "three points are enough", 0),
)
def rigid_fits_without_weight(seed: int) -> float:
    points = np.random.default_rng(seed).uniform(0, 300, (30, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = (np.zeros(30), np.eye(30)[0], np.eye(30)[:3].sum(0))
        motions = [fit_motion(points, points, w, PITCH, scale=True) for w in weights]
    return float(sum(motion is not None for motion in motions))


@case(
    "perception",
    why="small-angle formulas call a rotation a slip: 1 - cos 40 deg is a quarter of a pitch at the rim",
    holds="an exact rotation of any angle is found: deg or px off",
    guard=TANGENT,
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
    guard=Guard("service.perception.slip.rigid:fit_motion", "points are taken in single precision", of_floats),
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
    holds="a twist to 60 deg at 5 deg per frame is followed and shows no slip: largest score, or deg off",
    guard=Guard(
        "service.perception.slip.rigid:Motion.apply",
        "every angle is small",
        with_globals(np=like(np, cos=np.ones_like, sin=np.float64)),
    ),
    limit=0.1,
    quick=False,
)
def twists_of_sixty_degrees(seed: int) -> float:
    (first, *others), _ = patch_fields(rigid(degrees=5.0), frames=13, seed=seed)
    slip = SlipDetector()
    slip.rearm(first)
    states = [slip.update(field) for field in others]
    off_deg = [np.rad2deg(state.angle_rad) - 5.0 * k for k, state in enumerate(states, 1)]
    slips = [float("slip" in state.state) for state in states]
    return max(*slips, *(state.score for state in states), *np.abs(off_deg))
