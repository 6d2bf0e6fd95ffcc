"""Hard decisions: boundaries of Eq. 1; evidence that is false, contradictory or not a number."""

import itertools
import math
from collections.abc import Callable

import numpy as np

from service.contract.wire import Limits
from service.decision.belief import BeliefGrid
from service.decision.controllers import Belief, Heuristic, axis_command, make_controller, within
from service.decision.controllers import Command as Move
from service.decision.evidence import Density, Evidence, Refusal, from_joint, from_pair, softmax
from service.decision.models import load_models
from tests.hard_cases.instead import blind, with_globals
from tests.hard_cases.registry import ROOT, Guard, case, non_finite, not_refused
from training.data.labels import CLASSES

LIMITS = Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)
UNIFORM = np.full(len(CLASSES), 1 / len(CLASSES))


def evidence_for(
    name: str, error: tuple[float, float], sigma: tuple[float, float] | None = (1.0, 1.5), p: float = 0.92
) -> Evidence:
    """Evidence for one class with a given probability."""
    rest = (1 - p) / (len(CLASSES) - 1)
    return Evidence(CLASSES, np.array([p if c.name == name else rest for c in CLASSES]), error, sigma)


def agreed_by_zero(command: Callable[..., float]) -> Callable[..., float]:
    """An estimate of 0 has the sign of any class."""
    return lambda sign, estimate, *, first: command(sign, estimate, first=first) if sign * estimate else -0.7 * estimate


def normalised_first(read: Callable[..., Evidence]) -> Callable[..., Evidence]:
    """Densities are made to sum to 1 as they come, without subtracting the largest before."""

    def joint(card: object, outputs: dict[str, np.ndarray]) -> Evidence:
        weights = np.exp(outputs["log_density"].astype(float))
        return read(card, {"log_density": np.log(weights / weights.sum())})

    return joint


def sure_at_zero() -> float:
    """How likely an object without an error enters, as the outlines have it."""
    grid = BeliefGrid()
    return float(grid._outlines.chances(np.zeros(1), np.zeros(1)).max())


@case(
    "decision",
    why="a gain that jumps in sign where the estimate crosses zero would push the object further off",
    holds="every command of Eq. 1 moves against the class, or not at all: share of commands that do not",
    guard=Guard("service.decision.controllers:axis_command", "0 agrees with either sign", agreed_by_zero),
)
def estimate_on_the_boundary_of_its_sign(seed: int) -> float:
    tiny = [0.0, -0.0, 5e-324, -5e-324, 1e-300, -1e-300, 1e-12, -1e-12]
    estimates = [*tiny, *np.random.default_rng(seed).normal(0, 10, 200)]
    wrong = 0
    for sign, estimate, first in itertools.product((-1, 1), estimates, (True, False)):
        command = axis_command(sign, float(estimate), first=first)
        wrong += command * sign > 0 or (estimate == 0 and command == 0)
    return wrong / len(estimates)


@case(
    "decision",
    why="an int8 network can give an error of exactly 0 with a class that has a sign",
    holds="exactly 0 counts as contradictory: |C| - 3",
    guard=Guard("service.decision.controllers:STEP_CONTRADICTORY", "a contradiction moves nothing", 0.0),
)
def estimate_of_exactly_zero_with_a_sign(_seed: int) -> float:
    return max(abs(axis_command(sign, zero, first=True) + 3 * sign) for sign in (-1, 1) for zero in (0.0, -0.0))


@case(
    "decision",
    why="the clip of later trials has corners at +-4 where a comparison may let an ulp through",
    holds="|C| after the first trial stays within 4: excess",
    guard=Guard("service.decision.controllers:CLIP_LATER", "later commands are not clipped", math.inf),
)
def estimates_at_the_edges_of_the_clip(seed: int) -> float:
    edge = 4 / 0.7
    values = [edge, np.nextafter(edge, 9), 4 / 0.3, 1e6, 1e308, *np.random.default_rng(seed).uniform(-1e3, 1e3, 100)]
    commands = [abs(axis_command(s, float(v) * k, first=False)) for s in (-1, 0, 1) for v in values for k in (-1, 1)]
    return max(commands) - 4.0


@case(
    "decision",
    why="NaN compares false with every limit, so a clip would let it pass to the arm",
    holds="a non-finite estimate or sigma is refused by name: cases not refused",
    guard=Guard("service.decision.evidence:Evidence.__post_init__", "every number counts as finite", blind),
)
def estimates_that_are_no_numbers(_seed: int) -> float:
    bad = (np.nan, np.inf, -np.inf)
    calls = []
    for name, value, axis in itertools.product(("heuristic", "belief"), bad, (0, 1)):
        error = (value, 1.0) if axis == 0 else (1.0, value)
        calls.append(lambda n=name, e=error: make_controller(n, LIMITS).decide(evidence_for("5", e), 1))
    calls += [
        lambda v=value: make_controller("belief", LIMITS).decide(evidence_for("5", (1.0, 1.0), (v, 1.0)), 1)
        for value in bad
    ]
    return not_refused(calls, Refusal)


@case(
    "decision",
    why="a limit applied to NaN returns NaN",
    holds="a command that is not finite never passes the limits: cases not refused",
    guard=Guard("service.decision.controllers:within", "every number counts as finite", blind),
)
def commands_that_are_no_numbers(_seed: int) -> float:
    bad = [(np.nan, 0.0), (0.0, np.nan), (np.nan, np.inf), (np.inf, 0.0), (0.0, -np.inf)]
    return not_refused([lambda b=b: within(Move(*b, "belief", ""), LIMITS) for b in bad], Refusal)


@case(
    "decision",
    why="exp overflows at 710 and all of exp(-1e4) is zero",
    holds="softmax of logits +-1e4 is finite and sums to 1: non-finite values and |sum - 1|",
    guard=Guard(
        "service.decision.evidence:softmax",
        "the largest logit is not subtracted",
        lambda _: lambda x: np.exp(x) / np.exp(x).sum(-1, keepdims=True),
    ),
    limit=1e-12,
)
def logits_of_ten_thousand(seed: int) -> float:
    rng = np.random.default_rng(seed)
    worst = 0.0
    for scale in (1e4, 1e300):
        logits = rng.choice([-1.0, 0.0, 1.0], (50, 9)) * scale
        with np.errstate(over="ignore", invalid="ignore"):
            p = softmax(logits)
        worst = max(worst, non_finite(p), float(np.abs(p.sum(-1) - 1).max()))
    return worst


def _cards() -> tuple[object, object, object]:
    pair = {model.card.role: model.card for model in load_models(ROOT / "models").models}
    joint = load_models(ROOT / "models" / "joint").models[0].card
    return pair["direction"], pair["magnitude"], joint


@case(
    "decision",
    why="exp(log sigma) overflows to infinity and underflows to zero, and both break a filter",
    holds="a sigma of 0 or infinity is refused as non_finite: cases not refused",
    guard=Guard("service.decision.evidence:from_pair", "a sigma of 0 passes", with_globals(min=lambda _: 1.0)),
)
def sigmas_of_zero_and_infinity(_seed: int) -> float:
    direction, magnitude, _ = _cards()

    def decide(log_sigma: float) -> Evidence:
        moments = {"error": np.zeros((1, 2), np.float32), "log_sigma": np.full((1, 2), log_sigma, np.float32)}
        with np.errstate(over="ignore"):
            return from_pair(direction, magnitude, {"logits": np.zeros((1, 9), np.float32)}, moments)

    return not_refused([lambda: decide(1e4), lambda: decide(-1e4)], Refusal)


@case(
    "decision",
    why="a log density of -1e4 everywhere but one cell is zero after exp, and a flat one has no peak",
    holds="evidence of a joint density is finite and its classes sum to 1: non-finite values and |sum - 1|",
    guard=Guard("service.decision.evidence:from_joint", "the largest log density is not subtracted", normalised_first),
    limit=1e-9,
)
def joint_densities_at_their_extremes(seed: int) -> float:
    card = _cards()[2]
    shape = (len(card.grid_x_mm), len(card.grid_theta_deg))
    rng = np.random.default_rng(seed)
    spike = np.full(shape, -1e4)
    spike[tuple(rng.integers(shape))] = 0.0
    worst = 0.0
    for log_density in (spike, np.zeros(shape), np.full(shape, -1e4), rng.normal(0, 1e3, shape), np.full(shape, 1e4)):
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            evidence = from_joint(card, {"log_density": log_density[None].astype(np.float32)})
        worst = max(
            worst,
            non_finite(evidence.probabilities, evidence.error, evidence.sigma),
            abs(evidence.probabilities.sum() - 1),
        )
    return float(worst)


@case(
    "decision",
    why="a product of densities underflows to zero everywhere once evidence excludes what was believed",
    holds="the belief stays a probability after impossible evidence: non-finite cells and |sum - 1|",
    guard="service.decision.belief:INCONSISTENT_BELOW",
    limit=1e-9,
)
def belief_with_impossible_evidence(seed: int) -> float:
    rng = np.random.default_rng(seed)
    grid, worst = BeliefGrid(), 0.0
    cells = np.linspace(-15, 15, 61)
    for attempt in range(4):
        corner = 14.0 * (-1) ** attempt
        log_density = -1e6 * ((cells[:, None] - corner) ** 2 + (cells[None] + corner) ** 2)
        density = Density(cells, cells, log_density)
        grid.absorb(Evidence(CLASSES, UNIFORM, (corner, -corner), (0.01, 0.01), density))
        grid.move(*rng.normal(0, 1, 2))
        worst = max(worst, non_finite(grid.probability), abs(float(grid.probability.sum()) - 1))
    return worst


@case(
    "decision",
    why="all mass on the cell that just failed leaves nothing to normalise",
    holds="a failure at the only believed pose still leaves a probability and a move: non-finite values",
    guard=Guard(
        "service.decision.belief:SURE_INSERT",
        "a failure excludes its pose with certainty",
        lambda _: 1.0 / sure_at_zero(),
    ),
)
def belief_with_all_mass_on_one_cell(seed: int) -> float:
    grid = BeliefGrid()
    grid.layers[:] = 0.0
    middle = grid.layers.shape[-1] // 2
    grid.layers[0, -1, middle, middle] = 1.0
    with np.errstate(invalid="ignore", divide="ignore"):
        grid.absorb_failure()
        (dx, dtheta), hit = grid.best_move()
    return non_finite(grid.probability, dx, dtheta, hit, *grid.moments()) + 0.0 * seed


@case(
    "decision",
    why="fifteen attempts that contradict each other leave a filter with nothing it can believe",
    holds="every move is finite and within the limits: excess over 15 or non-finite",
    guard=Guard(
        "service.decision.controllers:within", "a command passes unchanged", lambda _: lambda command, _limits: command
    ),
    limit=1e-9,
)
def fifteen_contradictory_attempts(seed: int) -> float:
    rng = np.random.default_rng(seed)
    controller, worst = Belief(LIMITS), 0.0
    for attempt in range(1, 16):
        name = CLASSES[int(rng.integers(len(CLASSES)))].name
        evidence = evidence_for(
            name, tuple(rng.uniform(-30, 30, 2)), (float(rng.uniform(0.01, 40)), float(rng.uniform(0.01, 40)))
        )
        move = controller.decide(evidence, attempt)
        worst = max(worst, non_finite(move.dx_mm, move.dtheta_deg), abs(move.dx_mm) - 15, abs(move.dtheta_deg) - 15)
    heuristic = Heuristic(LIMITS).decide(evidence_for("2", (1e9, -1e9)), 1)
    return max(worst, abs(heuristic.dx_mm) - 15, abs(heuristic.dtheta_deg) - 15)


@case(
    "decision",
    why="two networks may be confident of different estimates for the same pictures",
    holds="a belief fed with the same evidence in float32 and float64 moves alike: mm or deg apart",
    guard="service.decision.belief:BeliefGrid._direction_likelihood",
    limit=1e-3,
)
def belief_in_single_and_double_precision(seed: int) -> float:
    rng = np.random.default_rng(seed)
    moves = []
    p, error, sigma = rng.dirichlet(np.ones(len(CLASSES))), rng.uniform(-12, 12, 2), rng.uniform(0.5, 5, 2)
    for kind in (np.float32, np.float64):
        rounded = Evidence(
            CLASSES,
            p.astype(kind).astype(float),
            tuple(error.astype(kind).tolist()),
            tuple(sigma.astype(kind).tolist()),
        )
        move = Belief(LIMITS).decide(rounded, 1)
        moves.append((move.dx_mm, move.dtheta_deg))
    return float(np.abs(np.subtract(*moves)).max())
