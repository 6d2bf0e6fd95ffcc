"""Hard contact: touchdowns, edges, singular and vanishing contacts, extremes of stiffness, friction and load."""

from collections.abc import Callable, Iterator

import numpy as np

from simulation.physics.quasistatic import CellState, PhysicsError, QuasiStaticCell
from simulation.scene.scene import SceneError
from simulation.scene.worlds import load_scene
from tests.hard_cases.registry import case, non_finite, not_refused
from tests.simulation.scenes import UPRIGHT

RESIDUAL_N, CONE = 1e-6, 1e-9


def grasped(name: str, x_mm: float, theta_deg: float, seed: int = 0, **changes: object) -> QuasiStaticCell:
    """An object in the hand above its gap."""
    cell = QuasiStaticCell(load_scene(name, **changes), seed)
    cell.regrasp(x_mm, theta_deg)
    return cell


def lowered(cell: QuasiStaticCell, depths: Iterator[float] | tuple[float, ...]) -> Iterator[CellState]:
    """The hand lowered to depths below the approach pose, one after the other."""
    x, y, z, yaw = cell.pose
    for depth in depths:
        yield cell.move_to(float(x), float(y), float(z) - depth, float(np.degrees(yaw)))


def condition(cell: QuasiStaticCell) -> str:
    """Condition number of the last solve's stiffness (mm and rad unscaled), and its remedy."""
    lower = np.tril(np.asarray(cell.trials["hess"][0], float))[:6, :6]
    number = np.linalg.cond(lower + np.tril(lower, -1).T)
    return f"condition {number:.0e}: the pads bound it, the diagonal is lifted by 1e-13 of its trace"


def worst_of(cell: QuasiStaticCell, depths: tuple[float, ...] = (4.9, 5.0, 5.001, 5.05, 5.5, 6.5)) -> float:
    """Largest of: residual over its bound, cone violation over its bound; infinite for a non-finite number."""
    worst = 0.0
    for state in lowered(cell, depths):
        if non_finite(state.gel, state.wrench_n_nmm, state.in_hand, state.object_error, state.block_motion):
            return np.inf
        if state.grasp_lost:
            break
        worst = max(worst, state.residual_n / RESIDUAL_N, float(cell.state["report"][4]) / CONE)
    return worst


HOLDS = "residual <= 1e-6 N, cone <= 1e-9, all finite: share of the bound used"
SOLVED = "simulation.physics.kernels.load_step:STALLED"
HALVED = "simulation.physics.quasistatic:MAX_HALVINGS"
REFUSED = "simulation.physics.quasistatic:QuasiStaticCell._divide"


def _scene_case(
    name: str, why: str, make: Callable[[int], QuasiStaticCell], guard: str = SOLVED, *, quick: bool = False
) -> None:
    def measure(seed: int) -> tuple[float, str]:
        cell = make(seed)
        return worst_of(cell), condition(cell)

    measure.__name__ = name.replace(" ", "_")
    case("physics", why=why, holds=HOLDS, guard=guard, limit=1.0, quick=quick)(measure)


_scene_case(
    "first touchdown",
    "contact stiffness jumps from nothing to 1000 N/mm within a micrometre",
    lambda seed: grasped("rectangle", 8.0, 5.0, seed),
    quick=True,
)
_scene_case(
    "corner at vanishing overlap",
    "a corner overlaps the block by a thousandth of a millimetre: one contact of no area",
    lambda seed: grasped("rectangle", 2.501 + 1e-3 * seed, 0.0, **UPRIGHT),
)
_scene_case(
    "edge parallel to edge",
    "at yaw 0 a whole edge touches at once and every split of the force along it is an equilibrium",
    lambda seed: grasped("rectangle", 6.0 + seed, 0.0, **UPRIGHT),
)
_scene_case(
    "redundant contact on both blocks",
    "centred and yawed, opposite corners rest on both blocks at once: more contacts than unknowns",
    lambda seed: grasped("rectangle", 0.0, 8.0 + seed, **UPRIGHT),
)
for _mu, _note in (
    (0.0, "no friction: nothing resists sliding along the edge"),
    (2.0, "a cone wider than 60 deg locks by itself"),
):
    _scene_case(
        f"edge friction {_mu:g}",
        _note,
        lambda seed, mu=_mu: grasped("rectangle", 8.0, 5.0, seed, blocks__friction=mu),
    )
_scene_case(
    "gel friction 2",
    "pads that never slip load until the geometry gives",
    lambda seed: grasped("hexagon", 8.0, 5.0, seed, gel__friction=2.0),
)
_scene_case(
    "heavy object in a light grip",
    "2 kg in 40 N: the weight alone takes a third of the friction",
    lambda seed: grasped("mustard", 8.0, 4.0, seed, object__mass_kg=2.0, grasp__force_n=40.0),
)
_scene_case(
    "object of a gram",
    "weight forces near the solver's residual",
    lambda seed: grasped("circle", 8.0, 0.0, seed, object__mass_kg=0.001),
)
_scene_case(
    "yaw of ninety degrees",
    "the long side lies across the gap and both ends touch at once",
    lambda seed: grasped("rectangle", 1.0 + seed, 90.0, theta_range_deg=45.0),
)
_scene_case(
    "free blocks pushed and tipped",
    "blocks of 20 g slide and tip under the object: eighteen unknowns, contacts that come and go",
    lambda seed: grasped(
        "rectangle", 8.0, 5.0, seed, blocks__free=True, blocks__mass_kg=0.02, blocks__table_friction=0.05
    ),
)
_scene_case(
    "touchdown in the layer tier",
    "nodes that feel each other couple every bristle to every other",
    lambda seed: grasped("rectangle", 8.0, 5.0, seed, gel__tier="layer"),
    guard="simulation.physics.layer_pads:LayerPads.advance",
)
for _tier in ("bristle", "layer"):
    for _name, _why, _gel, _guard in (
        (
            "nu 0.4999",
            "rubber that keeps its volume: normal over shear stiffness is 5,000",
            {"gel__poisson_ratio": 0.4999},
            "simulation.scene.rubber:reach_in_thicknesses",
        ),
        (
            "margin 0",
            "the gel ends with its outermost markers",
            {"gel__margin_mm": (0.0, 0.0)},
            "simulation.physics.pads:pad_of",
        ),
        (
            "margin 1000",
            "free edges a metre away, forced on",
            {"gel__margin_mm": (1000.0, 1000.0)},
            "simulation.scene.rubber:reach_in_thicknesses",
        ),
        (
            "relaxation share 0",
            "nothing relaxes, forced on",
            {"gel__relaxation_share": 0.0},
            "simulation.physics.layer_pads:pads_of",
        ),
        (
            "relaxation share 1",
            "a gel that flows like a fluid in 1 ms",
            {"gel__relaxation_share": 1.0, "gel__relaxation_s": 1e-3},
            "simulation.physics.layer_pads:Relaxation.crept",
        ),
        (
            "shear reach 50",
            "the gel can be sheared by fifty pitches before it slides, as far as its thickness bears the grip",
            {
                "gel__shear_modulus_n_per_mm2": 0.005,
                "gel__friction": 2.0,
                "gel__thickness_mm": 10.0,
                "grasp__force_n": 6.0,
            },
            HALVED,
        ),
        (
            "shear reach 0.01",
            "the gel slides at a hundredth of a pitch",
            {"gel__shear_modulus_n_per_mm2": 1.0, "gel__friction": 0.1},
            HALVED,
        ),
    ):
        _force = {f"effects__{key}": "on" for key in ("poisson", "gel_edges", "relaxation", "finger_compliance")}
        _scene_case(
            f"{_name}, {_tier} tier",
            _why,
            lambda seed, gel=_gel, tier=_tier, force=_force: grasped(
                "rectangle", 8.0, 5.0, seed, gel__tier=tier, **force, **gel
            ),
            guard=_guard,
        )


@case(
    "physics",
    why="gel a thousand times softer or stiffer than the blocks makes the stiffness matrix ill-conditioned",
    holds="six decades of stiffness solve or are refused by name: share of the bound used",
    guard=HALVED,
    limit=1.0,
    quick=False,
)
def gel_stiffness_over_six_decades(seed: int) -> tuple[float, str]:
    worst, refused, solved = 0.0, 0, 0
    ends = {"shear_modulus_n_per_mm2": (0.005, 5.0), "thickness_mm": (10.0, 0.3), "normal_ratio": (0.5, 50.0)}
    for share in np.linspace(0.0, 1.0, 7):
        gel = {f"gel__{key}": float(low * (high / low) ** share) for key, (low, high) in ends.items()}
        try:
            worst = max(worst, worst_of(grasped("rectangle", 8.0, 5.0, seed, **gel)))
            solved += 1
        except PhysicsError:
            refused += 1
    return (worst if solved else np.inf), f"{solved} solved, {refused} refused by name"


@case(
    "physics",
    why="contact stiffness over four decades scales one block of the matrix and not the others",
    holds="blocks from 5 to 50,000 N/mm solve: share of the bound used",
    guard="simulation.physics.kernels.convex:MAX_CONVEX",
    limit=1.0,
    quick=False,
)
def block_stiffness_over_four_decades(seed: int) -> float:
    stiffness = (5.0, 50.0, 1000.0, 50_000.0)
    return max(worst_of(grasped("rectangle", 8.0, 5.0, seed, blocks__stiffness_n_per_mm=k)) for k in stiffness)


@case(
    "physics",
    why="pads without friction hold nothing: gravity finds no equilibrium to settle in",
    holds="an object that cannot be held is refused by name or lost, never held by a rounding error: held",
    guard=REFUSED,
    quick=False,
)
def gel_friction_0(seed: int) -> tuple[float, str]:
    try:
        cell = grasped("hexagon", 8.0, 5.0, seed, gel__friction=0.0)
        worst_of(cell)
    except PhysicsError:
        return 0.0, "refused by name"
    return float(not cell.grasp_lost), "lost"


@case(
    "physics",
    why="an interference fit wedges: side walls on both sides and friction that locks them",
    holds="a part wider than its gap is refused by name: not refused",
    guard="simulation.scene.scene:Scene._can_exist",
)
def interference_fit(_seed: int) -> float:
    gaps = (50.8, 51.0, np.nextafter(51.0, 0))
    return not_refused([lambda g=g: load_scene("rectangle", blocks__gap_mm=g) for g in gaps], SceneError, "gap_mm")


@case(
    "physics",
    why="half a micrometre of clearance a side: both walls touch, with friction, all the way down",
    holds=HOLDS + "; or refused by name",
    guard=REFUSED,
    limit=1.0,
    quick=False,
)
def fit_without_clearance(seed: int) -> tuple[float, str]:
    cell = grasped("rectangle", 0.0, 0.0, seed, blocks__gap_mm=51.001, **UPRIGHT)
    try:
        return worst_of(cell, (4.5, 5.0, 5.5, 7.0, 12.0)), "solved"
    except PhysicsError as refusal:
        return 0.0, f"refused: {str(refusal)[:50]}"


@case(
    "physics",
    why="the first state is far inside the block: no Newton step starts near the solution",
    holds="3 mm of initial overlap in one load step is solved or refused by name: share of the bound used",
    guard=HALVED,
    limit=1.0,
    quick=False,
)
def deep_initial_overlap(seed: int) -> tuple[float, str]:
    cell = grasped("rectangle", 8.0, 5.0, seed, numerics__load_step_mm=1.0)
    try:
        return worst_of(cell, (8.0,)), "solved"
    except PhysicsError:
        return 0.0, "refused by name"


@case(
    "physics",
    why="a grip of half a newton holds nothing: the object is lost, which is a state and not an error",
    holds="grip forces down to 0.5 N end held, lost or refused by name, all finite: share of the bound used",
    guard="simulation.physics.quasistatic:LOST_GRIP",
    limit=1.0,
    quick=False,
)
def grip_force_to_nothing(seed: int) -> tuple[float, str]:
    worst, endings = 0.0, []
    for force_n in (20.0, 5.0, 1.0, 0.5):
        try:
            cell = grasped("rectangle", 8.0, 5.0, seed, grasp__force_n=force_n)
            worst = max(worst, worst_of(cell))
            endings.append("lost" if cell.grasp_lost else "held")
        except PhysicsError:
            endings.append("refused")
    return worst, ", ".join(endings)
