"""Hard inputs to the released networks: nothing or too much visible, endless streams, small and huge numbers."""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.onnx.golden import golden_input, hard_input
from export.onnx.model import Arrays, Model, geometry_inputs, open_model, steps
from export.onnx.verify import decide, run_steps
from service.contract import ContractError
from service.decision.evidence import DecisionRun, Refusal
from service.decision.models import load_models
from tests.hard_cases.instead import blind, waved_through
from tests.hard_cases.registry import ROOT, Guard, case, non_finite, not_refused

MARKERS = ("direction", "magnitude", "joint/joint")
PICTURES = ("pictures/direction", "pictures/magnitude")
STEPS = ("pressing/pair", "pressing/joint/joint")
NAMES = (*MARKERS, *PICTURES, *STEPS)
LARGEST = 1e4
KINDS = {
    PICTURES: ("picture", "training.networks.preprocessing:block_sums"),
    MARKERS: ("markers", "training.networks.markers:MarkerNetwork._change"),
    STEPS: ("steps", "training.networks.pressing:PressingNetwork.encode"),
}


@lru_cache
def released(name: str, form: str = "step", threads: int = 1) -> Model:
    """A released model, opened once."""
    return open_model(ROOT / "models" / f"{name}.{form}.onnx", threads)


def _gap(one: Arrays, other: Arrays) -> float:
    return max(float(np.abs(one[n] - other[n]).max() / max(1.0, np.abs(other[n]).max())) for n in one if n in other)


def largest_of(outputs: Arrays) -> float:
    """Largest output, infinite if one is not finite."""
    return max(float(np.abs(value).max()) if np.isfinite(value).all() else np.inf for value in outputs.values())


def golden(seed: int, name: str = "pictures/direction") -> NDArray[Any]:
    """A golden decision as the released network reads it: pictures or marker fields."""
    return golden_input(released(name).card, seed)


def _hard_case(name: str, why: str, networks: tuple[str, ...] = PICTURES) -> None:
    def measure(_seed: int) -> float:
        worst = 0.0
        for network in networks:
            model = released(network)
            frames = hard_input(model.card)[name]
            worst = max(worst, largest_of(decide(model, frames[None])))
        return worst

    kind, guard = KINDS[networks]
    measure.__name__ = f"{kind}_{name.replace(' ', '_')}"
    case(
        "networks",
        why=why,
        holds=f"every output of every released network that reads {kind} is finite and bounded: largest",
        guard=guard,
        limit=LARGEST,
    )(measure)


_hard_case("no difference", "the difference to the reference is zero everywhere, and a norm of it would be a divisor")
_hard_case("single bright pixel", "one pixel of 100,000 carries all of the difference")
_hard_case("black", "no light at all: every contrast is 0")
_hard_case("saturated", "every pixel is clipped at 255")
_hard_case("black and white in turn", "the difference is the largest that uint8 holds, with either sign")
_hard_case("noise", "nothing like a marker anywhere")
IMPOSSIBLE = {
    "single leaping marker": "one of hundreds, taken for another, leaps a hundred pixels or mm",
    "one marker left": "a mean and a spread over a single point, on one finger only",
    "torn off and back in turn": "displacements of ten thousand come and go",
    "noise": "displacements of hundreds with no pattern",
}
for _networks in (MARKERS, STEPS):
    _hard_case("no difference", "no marker moved: every displacement is exactly zero", _networks)
    _hard_case("nothing seen", "every marker is lost, and a mean over those seen would divide by none", _networks)
    _hard_case("denormals", "displacements below 1e-38 have fewer digits", _networks)
    for _name, _why in IMPOSSIBLE.items():
        _hard_case(_name, _why, _networks)


@case(
    "networks",
    why="uint8 minus uint8 wraps: 0 - 1 is 255",
    holds="a darker frame reads as the mirror of a brighter one, not as white: outputs that jump",
    guard="training.networks.preprocessing:block_sums",
    limit=0.5,
)
def differences_of_minus_one(seed: int) -> float:
    frames = golden(seed)
    frames = np.clip(frames, 1, 254)
    model, worst = released("pictures/magnitude"), 0.0
    still = np.repeat(frames[:1], len(frames), 0)
    for step in (1, -1):
        moved = still.copy()
        moved[1:] = (still[1:].astype(int) + step).astype(np.uint8)
        moved_to, rest = decide(model, moved[None])["error"], decide(model, still[None])["error"]
        worst = max(worst, float(np.abs(moved_to - rest).max()) / 10.0)
    return worst


@case(
    "networks",
    why="a recurrent state may grow step by step where nobody resets it",
    holds="after a stream of 10,000 steps state and outputs are finite and bounded: largest",
    guard="training.networks.decider:Trunk.advance",
    limit=LARGEST,
    quick=False,
)
def streams_of_ten_thousand_steps(seed: int) -> float:
    each = [steps(released(name), golden(seed, name)[None], 10_000) for name in NAMES[seed::3]]
    return max(largest_of(outputs) for stream in each for outputs in stream)


@case(
    "networks",
    why="the state of a step comes from outside the graph and may be any float",
    holds="states of +-1e4 give finite, bounded outputs: largest",
    guard="training.networks.forms:within_reach",
    limit=1e6,
)
def states_of_ten_thousand(seed: int) -> float:
    rng, worst = np.random.default_rng(seed), 0.0
    for name in NAMES:
        frames, model = golden(seed, name)[None], released(name)
        state = (rng.choice([-1.0, 1.0], (1, model.card.state_size)) * 1e4).astype(np.float32)
        fed: Arrays = {"frame": frames[:, 5], "reference": frames[:, 0], "state": state}
        worst = max(worst, largest_of(model(fed | geometry_inputs(model.card, 1))))
    return worst


@case(
    "networks",
    why="states are clamped, and the clamp of a runtime may turn NaN into a number",
    holds="a state with one NaN or infinity leaves no network with finite outputs: networks that decide",
    guard="training.networks.forms:within_reach",
)
def states_that_are_no_numbers(seed: int) -> float:
    decided = 0
    for name in NAMES:
        frames, model = golden(seed, name)[None], released(name)
        for value in (np.nan, np.inf, -np.inf):
            state = np.zeros((1, model.card.state_size), np.float32)
            state[0, seed] = value
            fed: Arrays = {"frame": frames[:, 5], "reference": frames[:, 0], "state": state}
            outputs = model(fed | geometry_inputs(model.card, 1))
            outputs.pop("strangeness", None)  # of the step alone
            decided += any(np.isfinite(output).all() for output in outputs.values())
    return float(decided)


@case(
    "networks",
    why="numbers below 1e-38 have fewer digits, and some processors drop them to zero",
    holds="denormal states decide as zero states do: relative gap",
    guard="export.onnx.runtime:session",
    limit=1e-5,
)
def states_of_denormals(seed: int) -> float:
    worst = 0.0
    for name in NAMES:
        frames, model = golden(seed, name)[None], released(name)
        outputs = []
        for value in (0.0, 1e-40, -1e-44):
            state = np.full((1, model.card.state_size), value, np.float32)
            fed: Arrays = {"frame": frames[:, 5], "reference": frames[:, 0], "state": state}
            outputs.append(model(fed | geometry_inputs(model.card, 1)))
        worst = max(worst, _gap(outputs[1], outputs[0]), _gap(outputs[2], outputs[0]))
    return worst


@case(
    "networks",
    why="the gap width is an input too, and a cell may have any",
    holds="gap widths from 5 to 250 mm give finite, bounded outputs: largest",
    guard="training.networks.decider:geometry_features",
    limit=LARGEST,
)
def gap_widths_far_from_training(seed: int) -> float:
    worst = 0.0
    for name in NAMES:
        frames, model = golden(seed, name)[None], released(name)
        for gap_mm in (5.0, 250.0):
            cell = geometry_inputs(model.card, 1, gap_mm, gap_mm)
            worst = max(worst, *map(largest_of, steps(model, frames, frames.shape[1], cell)))
    return worst


@case(
    "networks",
    why="kernels sum in another order for another batch",
    holds="a decision alone equals the same in a batch of 64: relative gap",
    guard="export.onnx.verify:_batch_gap",
    limit=1e-5,
    quick=False,
)
def batches_of_one_and_of_sixty_four(seed: int) -> float:
    worst = 0.0
    for name in NAMES:
        frames, model = golden(seed, name)[None], released(name)
        alone, crowd = run_steps(model, frames), run_steps(model, np.repeat(frames, 64, 0))
        worst = max(worst, *(_gap(alone, {n: v[row : row + 1] for n, v in crowd.items()}) for row in (0, 31, 63)))
    return worst


@case(
    "networks",
    why="two threads split a sum",
    holds="one thread and two give the same decision: relative gap",
    guard="export.onnx.verify:verify_model",
    limit=1e-5,
    quick=False,
)
def threads_one_and_two(seed: int) -> float:
    worst = 0.0
    for name in NAMES:
        frames = golden(seed, name)[None]
        worst = max(worst, _gap(decide(released(name), frames), decide(released(name, "step", 2), frames)))
    return worst


@case(
    "networks",
    why="the service decides step by step, the offline tools by whole sequences",
    holds="both forms of each network decide alike, on golden and on hard frames: relative gap",
    guard="training.networks.forms:SequenceForm.forward",
    limit=1e-5,
    quick=False,
)
def steps_against_sequences(seed: int) -> float:
    worst = 0.0
    for name in (*MARKERS, *PICTURES):  # those that read steps of depth have the one form
        step, sequence = released(name), released(name, "sequence")
        inputs = [golden(seed, name), *hard_input(step.card).values()]
        worst = max(worst, *(_gap(decide(sequence, frames[None]), decide(step, frames[None])) for frames in inputs))
    return worst


@case(
    "networks",
    why="a frame of another size or type fits a buffer of the same length",
    holds="frames of another shape are refused by name, too few frames give no decision: not refused",
    guard=Guard("service.contract.model_card:ModelCard.check", "a pair of any shape passes", waved_through),
)
def frames_of_another_shape(seed: int) -> float:
    missed = 0.0
    for folder, reads in (("pictures", "uint8"), ("pressing", "float32"), ("pressing/joint", "float32")):
        models = load_models(ROOT / "models" / folder)
        pair = golden_input(models.card, seed)[0]
        other = np.float32 if reads == "uint8" else np.uint8
        bad = [pair[:, :, :-1], pair.astype(other), pair[:, :-1], pair[..., 0]]
        calls = [lambda f=f, m=models, p=pair: DecisionRun(m, p, 56.0).step(f) for f in bad]
        missed += not_refused(calls, ContractError, f"reads {reads}")
        missed += not_refused([DecisionRun(models, pair, 56.0).evidence], Refusal)
    return missed


@case(
    "networks",
    why="a network may output NaN when its file is damaged",
    holds="a non-finite output is no decision: not refused, non-finite evidence",
    guard=Guard("service.decision.evidence:DecisionRun.evidence", "every output counts as finite", blind),
)
def outputs_that_are_no_numbers(_seed: int) -> float:
    missed = 0.0
    for folder in ("", "joint", "pictures", "pressing", "pressing/joint"):
        models = load_models(ROOT / "models" / folder)
        still = hard_input(models.card)["no difference"]
        good, *damaged = [DecisionRun(models, still[0], 56.0) for _ in range(3)]
        for run, bad in zip(damaged, (np.nan, np.inf), strict=True):
            for pair in still:
                run.step(pair)
            run._outputs[0] = {name: np.full_like(value, bad) for name, value in run._outputs[0].items()}
            missed += not_refused([run.evidence], Refusal, "network gave a non-finite output")
        for pair in still:
            good.step(pair)
        evidence = good.evidence()
        missed += non_finite(evidence.probabilities, evidence.error, evidence.sigma)
    return missed
