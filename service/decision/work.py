"""The networks' work for one attempt, and the rules by which their evidence becomes a correction or is refused."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.contract import wire
from service.contract.model_card import CONDITIONS, ModelCard
from service.decision.attempt import Attempt, Stage, WorkResult
from service.decision.consistency import turns_deg
from service.decision.controllers import Command
from service.decision.evidence import DecisionRun, Evidence, Refusal, paused
from service.decision.models import Array, ModelSet
from service.decision.network_input import Descent, check_trained, network_pair
from service.perception.observation import Observation, PairObservation
from service.settings import Deadlines

MIN_VALID_MARKERS = 0.5  # share of a finger's markers, in the last frame of the decision


@dataclass(frozen=True, slots=True)
class Work:
    """One piece of network work: a pure computation; ``run`` returns a result only after an attempt's last frame."""

    run: Callable[[], WorkResult | None]


def plan(models: ModelSet, attempt: Attempt) -> list[Work]:
    """All network work that the newest pair makes possible, in order."""
    card = models.card
    if card.pressing:
        return plan_steps(models, attempt)
    pairs = attempt.take_decision_pairs(card.frames_per_decision)
    return [plan_work(models, attempt, pair) for pair in pairs]


def plan_work(models: ModelSet, attempt: Attempt, pair: PairObservation) -> Work:
    """The networks' step on one pair of the attempt's decision; the step on its last pair returns the result."""
    named = attempt.arm.insertion_id, attempt.generation
    if attempt.run is None:
        try:
            reference = network_pair(models.card, attempt.network_reference or pair)
        except Refusal as refusal:
            refused = WorkResult(*named, None, refusal, {})
            return Work(lambda: refused)
        attempt.run = DecisionRun(models, reference, attempt.arm.gap_width_mm, attempt.arm.grasp_height_mm)
    pairs = attempt.decision_pairs
    complete = pair is pairs[-1] and len(pairs) >= models.card.frames_per_decision
    attempt.fed = attempt.fed or complete
    return _steps(attempt, attempt.run, pair, lambda: [network_pair(models.card, pair)], complete=complete)


def _steps(
    attempt: Attempt,
    run: DecisionRun,
    pair: PairObservation,
    shown: Callable[[], Iterable[Array]],
    *,
    complete: bool,
) -> Work:
    """The networks' steps on what is ``shown`` up to ``pair``; those that make the input ``complete`` have a result."""
    named = attempt.arm.insertion_id, attempt.generation

    def compute() -> WorkResult | None:
        try:
            for one in shown():
                run.step(one)
            if not complete:
                return None
            return WorkResult(*named, run.evidence(), None, latencies(run, pair), run)
        except Refusal as refusal:
            return WorkResult(*named, None, refusal, {}, run)
        except Exception as error:
            return WorkResult(*named, None, Refusal("non_finite", f"the networks failed: {error}"), {}, run)

    return Work(compute)


def plan_steps(models: ModelSet, attempt: Attempt) -> list[Work]:
    """The networks' steps of depth that the newest pair completes; the last ones return the result.

    There are none after the card's last step, after an order to stop, or where no depth is known.
    """
    assert models.card.pressing is not None
    if attempt.fed:
        return []
    steps, pair, descent = attempt.take_steps(models.card), attempt.ring[-1], attempt.descent
    read_n = models.card.pressing.steps_n
    steps = steps[: max(0, read_n - len(attempt.steps) + len(steps))]
    if descent is None or attempt.dismisses(descent):
        return []
    problem = descent.problem
    attempt.fed = descent.enough or attempt.spoilt or attempt.stage is Stage.STOPPED or problem is not None
    if attempt.run is None:
        attempt.run = _run_of_steps(models, attempt, descent)
    if not (steps or attempt.fed):
        return []

    def shown() -> Iterator[Array]:
        yield from steps
        if problem is not None:
            raise problem

    return [_steps(attempt, attempt.run, pair, shown, complete=attempt.fed)]


def _run_of_steps(models: ModelSet, attempt: Attempt, descent: Descent) -> DecisionRun:
    still = np.zeros((2, *models.card.input_shape), np.float32)
    still[..., 2] = 1.0  # a step is already a change, and states its own visibility
    return DecisionRun(models, still, attempt.arm.gap_width_mm, attempt.arm.grasp_height_mm, descent.conditions)


def decide_again(models: ModelSet, attempt: Attempt) -> Evidence:
    """The evidence of other networks from the same input of an attempt.

    Raises Refusal if these would refuse, or if there was no input.
    """
    card, descent = models.card, attempt.descent
    if card.pressing:
        if descent is None or descent.problem is not None:
            raise descent.problem if descent and descent.problem else Refusal("no_motion", "no step of depth was shown")
        # its ranges may be narrower than the active version's
        check_trained(card, descent.conditions, attempt.decision_pairs[-1:])
        run, shown = _run_of_steps(models, attempt, descent), list(attempt.steps[: card.pressing.steps_n])
    else:
        if attempt.network_reference is None:
            raise Refusal("no_motion", "no frame pair was shown")
        reference = network_pair(card, attempt.network_reference)
        run = DecisionRun(models, reference, attempt.arm.gap_width_mm, attempt.arm.grasp_height_mm)
        shown = [network_pair(card, pair) for pair in attempt.decision_pairs]
    for one in shown:
        run.step(one)
    return run.evidence()


def latencies(run: DecisionRun, last: PairObservation) -> dict[str, float]:
    """Milliseconds by stage for the last frame pair: each finger's perception, and the networks' last step."""
    slowest = {stage: max(finger.cost_ms.get(stage, 0.0) for finger in last.fingers) for stage in last.left.cost_ms}
    return slowest | {"networks_last_step": run.step_ms}


def unknown_depth(attempt: Attempt) -> Refusal | None:
    """Why it is not known how far the arm had pressed in an attempt's pictures, None if it is."""
    if attempt.broken:
        return Refusal("stale", f"a camera failed during the attempt: {attempt.broken}")
    if attempt.stale_sent:
        why = "the frames grew too old during the attempt"
    elif attempt.outcome == "stopped":  # what came since it stood shows no further press
        why = "the arm stopped for another reason than slip or enough"
    else:
        return None
    return Refusal("stale", f"{why}, so the depth of its pictures is not known")


def check_evidence(models: ModelSet, attempt: Attempt, evidence: Evidence) -> None:
    """Raise Refusal if the evidence is too weak, of no known depth, or of too few markers to be imprints."""
    if refusal := unknown_depth(attempt):
        raise refusal
    if not attempt.decision_pairs:
        raise Refusal("no_motion", "no pair shows the motion that the evidence is of")
    if attempt.paused_in_press:
        raise paused()
    threshold = max(step.card.min_confidence for step in models.steps)
    if not evidence.confidence >= threshold:
        raise Refusal("low_confidence", f"class probability {evidence.confidence:.2f}, expected {threshold:g}")
    for finger in attempt.decision_pairs[-1].fingers:
        share = float(finger.field.valid.mean()) if finger.field.valid.size else 0.0
        if finger.field.status != "duplicate" and not share >= MIN_VALID_MARKERS:
            detail = f"{finger.finger} finger shows {share:.0%} of its markers, expected {MIN_VALID_MARKERS:.0%}"
            raise Refusal("out_of_distribution", detail)


def slip_message(attempt: Attempt, observation: Observation, now_ns: int) -> wire.Slip:
    """The order to stop: the frame and finger with the slip, and the frame's age."""
    return wire.Slip(
        **attempt.named,
        finger=observation.finger,
        frame_seq=observation.seq,
        captured_ns=observation.captured_ns,
        age_ms=(now_ns - observation.captured_ns) / 1e6,
        score=float(observation.slip.score),
        reason=f"{observation.slip.state}: {observation.slip.reason}",
        pressed_mm=attempt.descent.pressed_at_mm(observation.captured_ns) if attempt.descent else None,
    )


def enough_message(attempt: Attempt) -> Iterator[wire.Enough]:
    """The order to stop, if the networks have all their input while the arm is still descending."""
    descent, pair = attempt.descent, attempt.ring[-1]
    if attempt.stage is Stage.ARMED and not attempt.slip_sent and descent is not None and descent.enough:
        attempt.stops(pair.captured_ns)
        yield wire.Enough(
            **attempt.named,
            frame_seq=pair.seq,
            captured_ns=pair.captured_ns,
            pressed_mm=descent.pressed_mm,
        )


def correction(attempt: Attempt, evidence: Evidence, command: Command, latency_ms: dict[str, float]) -> wire.Correction:
    """The message with a command and its evidence."""
    return wire.Correction(
        **attempt.named,
        dx_mm=command.dx_mm,
        dtheta_deg=command.dtheta_deg,
        class_probabilities=evidence.class_probabilities(),
        estimate=evidence.estimate(),
        confidence=min(1.0, evidence.confidence),
        controller=command.controller,
        reason=command.reason,
        latency_ms=latency_ms,
        turns_deg=shown_turns_deg(attempt),
    )


def shown_turns_deg(attempt: Attempt) -> tuple[float, float] | None:
    """Turn of the object as each finger saw it last, clockwise in its picture; None where one saw none."""
    turns = turns_deg(attempt.ring[-1]) if attempt.ring else (math.nan, math.nan)
    return turns if all(map(math.isfinite, turns)) else None


def overdue(attempt: Attempt, waited_s: float, card: ModelCard, deadlines: Deadlines) -> Refusal | None:
    """Why no decision will come any more, None while it still may."""
    have, needed = len(attempt.decision_pairs), card.frames_per_decision
    if attempt.fed or (not card.pressing and have >= needed):  # steps of depth are no pairs: one may still be missing
        late = waited_s > deadlines.decision_s
        return Refusal("stale", f"the networks took longer than {deadlines.decision_s:g} s") if late else None
    if waited_s <= deadlines.decision_frames_s:
        return None
    if not have:
        last_pair = attempt.ring[-1].fingers if attempt.ring else ()
        empty = bool(last_pair) and all(finger.slip.state == "no_contact" for finger in last_pair)
        why = "nothing touches the gels" if empty else "neither finger saw the object move"
        return Refusal("no_motion", why)
    if card.pressing:
        return Refusal("too_few_frames", "no pair came after the stop")
    return Refusal("too_few_frames", f"{have} frame pairs since motion began, expected {needed}")


def arrays_of(attempt: Attempt) -> dict[str, NDArray[np.generic]]:
    """The frames of the decision, as :mod:`service.recordings.writer` documents for ``attempt_XX.npz``."""
    reference = attempt.network_reference or attempt.reference
    if reference is None:
        return {}
    pairs = attempt.decision_pairs or [reference]
    last = pairs[-1].fingers
    return {
        "frames": np.stack([pair.pixels() for pair in pairs]),
        "reference": reference.pixels(),
        "frame_seq": np.array([pair.seq for pair in pairs], np.int64),
        "captured_ns": np.array([pair.captured_ns for pair in pairs], np.int64),
        "rest_px": np.stack([finger.field.rest_px for finger in last]),
        "displacement_px": np.stack([finger.field.displacement_px for finger in last]),
        "valid": np.stack([finger.field.valid for finger in last]),
        **read_by_depth(attempt),
    }


def read_by_depth(attempt: Attempt) -> dict[str, NDArray[np.generic]]:
    """The decision, and the input of networks that read steps of depth; no pictures."""
    decision = {"decision": np.array(attempt.decision.model_dump_json() if attempt.decision else "{}")}
    if not attempt.steps or attempt.descent is None or attempt.reference is None:
        return decision
    conditions = [attempt.descent.conditions.get(name) or 0.0 for name in CONDITIONS]
    steps = {"steps": np.stack(attempt.steps), "conditions": np.array(conditions, np.float32)}
    return {**decision, **steps, "held_px": attempt.reference.markers_px()}
