"""Hard histories of contact: holding, going to and fro, steps of any length, mirrored and random starts."""

import itertools
from typing import Any

import numpy as np

from simulation.physics.quasistatic import QuasiStaticCell
from tests.hard_cases.instead import blind
from tests.hard_cases.registry import Guard, case, non_finite, not_refused
from tests.hard_cases.rooms.physics import (
    CONE,
    HALVED,
    HOLDS,
    REFUSED,
    RESIDUAL_N,
    SOLVED,
    grasped,
    lowered,
    worst_of,
)
from tests.simulation.scenes import UPRIGHT


@case(
    "physics",
    why="a regularised friction creeps: standing still for a second moves the object",
    holds="force drift over 300 load steps of a nanometre up and down: relative",
    guard="simulation.physics.kernels.bristles:settle",
    limit=1e-3,
    quick=False,
)
def hold_of_a_second(seed: int) -> float:
    cell = grasped("rectangle", 8.0, 5.0, seed)
    *_, state = lowered(cell, (5.5, 6.3))
    before = state.wrench_n_nmm.copy()
    x, y, z, yaw = cell.pose
    for k in range(300):
        state = cell.move_to(float(x), float(y), float(z) + 1e-9 * (-1) ** k, float(np.degrees(yaw)))
    return float(np.linalg.norm(state.wrench_n_nmm[:3] - before[:3]) / np.linalg.norm(before[:3]))


@case(
    "physics",
    why="bristles that slipped remember where; on the way back they stick first and then slip the other way",
    holds=HOLDS,
    guard=SOLVED,
    limit=1.0,
    quick=False,
)
def stick_slip_reversal(seed: int) -> float:
    return worst_of(grasped("rectangle", 8.0, 5.0, seed), (5.2, 6.0, 5.3, 6.2, 5.1, 6.4, 4.8, 6.0))


@case(
    "physics",
    why="a part between both walls locks: its friction limits follow each other and come 1 to 2 % closer per round",
    holds="a part pushed down until it wedges reaches its equilibrium, in 1,000 tries at most: share of the bound used",
    guard=Guard(
        "simulation.physics.kernels.convex:FINISH_EVERY", "damped rounds are never ended by the coupled Newton", 10**9
    ),
    limit=1.0,
    quick=False,
)
def wedged_between_both_walls(seed: int) -> float:
    rng = np.random.default_rng(seed)
    starts = [(rng.uniform(-2.5, 2.5), rng.uniform(3.5, 6.0) * rng.choice((-1.0, 1.0))) for _ in range(2)]
    return max(_wedged(grasped("mustard", x, theta, seed)) for x, theta in starts)


def _wedged(cell: QuasiStaticCell) -> float:
    tries, one_try = itertools.count(1), cell._pass

    def counted(*step: Any) -> int:
        assert next(tries) <= 1000
        return one_try(*step)

    cell._pass = counted  # type: ignore[method-assign]
    return worst_of(cell, (6.0, 8.0, 10.0, 12.0, 14.0))


@case(
    "physics",
    why="one step of 1.5 mm crosses touchdown, sticking and slip at once; a thousand small ones add their rounding",
    holds="in-hand position from 1, 4, 32 and 1024 load steps agrees: mm apart from the finest",
    guard=HALVED,
    limit=0.03,
    quick=False,
)
def load_steps_from_one_to_1024(seed: int) -> tuple[float, str]:
    ends = []
    for count in (1, 4, 32, 1024):
        cell = grasped("rectangle", 8.0, 3.0 * seed, **UPRIGHT)
        *_, state = lowered(cell, tuple(4.9 + 1.5 * (k + 1) / count for k in range(count)))
        ends.append(state.in_hand[:3].copy())
    apart = [float(np.linalg.norm(end - ends[-1])) for end in ends[:-1]]
    return apart[-1], f"1, 4, 32 steps: {', '.join(f'{1e3 * a:.1f}' for a in apart)} um"


@case(
    "physics",
    why="two solvers that stop early stop at different places",
    holds="the coupled and the convex solver find one equilibrium: mm apart",
    guard="simulation.physics.kernels.load_step:advance",
    limit=2e-4,
    quick=False,
)
def two_solvers_of_one_equilibrium(seed: int) -> float:
    ends = []
    for direct in (True, False):
        cell = grasped("rectangle", 6.0 + seed, 4.0, **UPRIGHT)
        cell.direct = direct
        *_, state = lowered(cell, (5.5, 6.2))
        ends.append(state.in_hand.copy())
    return float(np.abs(ends[0] - ends[1]).max())


@case(
    "physics",
    why="mirrored input must give mirrored output, or something depends on the order of a loop",
    holds="a mirrored start gives the mirrored force: relative gap",
    guard=SOLVED,
    limit=1e-4,
    quick=False,
)
def mirrored_starts(seed: int) -> float:
    forces = []
    for side in (1.0, -1.0):
        cell = grasped("rectangle", side * (6.0 + seed), side * 4.0, **UPRIGHT)
        *_, state = lowered(cell, (5.5, 6.0))
        forces.append(state.wrench_n_nmm[:3] * (side, 1.0, 1.0))
    return float(np.abs(forces[0] - forces[1]).max() / np.abs(forces[0]).max())


@case(
    "physics",
    why="a hand commanded to NaN takes its object along",
    holds="a NaN pose is refused by name and the state does not change: not refused",
    guard=Guard("simulation.physics.quasistatic:QuasiStaticCell.move_to", "every number counts as finite", blind),
)
def poses_that_are_no_numbers(seed: int) -> float:
    cell = grasped("rectangle", 8.0, 5.0, seed)
    bad = (np.nan, np.inf, -np.inf)
    calls = [lambda v=v, k=k: cell.move_to(*[v if i == k else 0.0 for i in range(4)]) for v in bad for k in range(4)]
    missed = not_refused([*calls, *(lambda v=v: cell.regrasp(v, 0.0) for v in bad)], ValueError)
    return missed + non_finite(cell.look().gel)


@case(
    "physics",
    why="seeds differ in tilt, grip and optics, and one of them may be the one that stalls",
    holds="random hard probes solve within the bounds or are refused by name: share of the bound used",
    guard=REFUSED,
    limit=1.0,
    quick=False,
)
def random_hard_probes(seed: int) -> tuple[float, str]:
    from simulation.studies.hard_probes import Tally, hard_probe

    tally = Tally()
    for number in range(60):
        hard_probe(1000 + seed, number, "bristle", tally)
    used = max(tally.worst_residual_n / RESIDUAL_N, tally.worst_cone_n_per_mm2 / CONE)
    return used, ", ".join(f"{count} {ended}" for ended, count in sorted(tally.ended.items()))
