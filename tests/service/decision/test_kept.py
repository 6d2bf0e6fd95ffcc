"""The same evidence gives the same moves, doubts and refusals as it did: fitted constants do not move unnoticed."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.contract import wire
from service.contract.model_card import Expectations
from service.decision.consistency import Consistency, one_sided
from service.decision.controllers import Belief, Command, make_controller
from service.decision.evidence import Density, Evidence, Refusal
from service.perception.turning import hangs_turned, lasting_turn_deg, turned_going_in
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage
from tests.kept import is_as_kept
from tests.service.decision.test_claim import blocked, descent, pair, reasons
from tests.service.decision.test_consistency import BLIND, GOOD, REVERSED, correction
from tests.service.decision.test_consistency import pair as turned_pair
from tests.service.decision.test_controllers import certain
from tests.service.decision.toy_loop import LIMITS
from tests.service.perception.test_turning import FREE, hanging, last
from tests.service.tiny_models import CLASSES

MODELS = Path(__file__).parents[3] / "models" / "pressing"
AXIS = np.linspace(-15, 15, 61)


def evidence(name: str, error: tuple[float, float], sigma: tuple[float, float] | None) -> Evidence:
    return replace(certain(name, *error), sigma=sigma)


def density(x_mm: float, theta_deg: float) -> Evidence:
    """Two peaks, one of which holds three quarters."""
    off = [((AXIS[:, None] - x) / 2.0) ** 2 + ((AXIS - y) / 3.0) ** 2 for x, y in ((x_mm, theta_deg), (-x_mm, 0.0))]
    log_density = np.log(0.75 * np.exp(-0.5 * off[0]) + 0.25 * np.exp(-0.5 * off[1]))
    return Evidence(CLASSES, np.full(9, 1 / 9), (x_mm, theta_deg), (2.0, 3.0), Density(AXIS, AXIS, log_density))


SEARCH = [
    evidence("5", (9.0, 7.0), (2.2, 2.9)),
    evidence("2", (4.0, 1.0), (2.6, 4.1)),
    None,
    evidence("1", (-2.5, -3.0), (3.0, 4.4)),
    evidence("near", (0.8, 1.2), (2.5, 3.6)),
    evidence("6", (2.0, -4.0), None),
]
STORIES: dict[str, tuple[dict[str, Any], list[Evidence | None]]] = {
    "a search": ({}, SEARCH),
    "held high and long": ({"grasp_height_mm": 80.0, "length_mm": 107.0}, SEARCH),
    "other networks": (
        {"grasp_height_mm": 50.0, "expected": Expectations(edge=(12.0, 10.0), creep_mm=-0.6, tolerance=(1.5, 2.5))},
        SEARCH,
    ),
    "densities": ({}, [density(6.0, -4.0), density(-3.0, 2.0), density(2.0, 2.0)]),
    "a contradiction": (
        {},
        [
            evidence("5", (3.0, 6.0), (1.0, 1.5)),
            evidence("near", (2.4, 3.0), (1.0, 1.5)),
            evidence("near", (2.4, 3.0), (1.0, 1.5)),
            evidence("4", (-14.0, -12.0), (0.5, 0.5)),
            evidence("1", (-6.0, -3.0), (1.0, 1.5)),
        ],
    ),
    "twice the error": ({}, [evidence("2", (2.0 * x_mm, 0.0), (0.8, 1.5)) for x_mm in (6.0, -5.0, 3.0)]),
}


@pytest.mark.parametrize("name", STORIES)
def test_a_belief_moves_by_the_same_evidence_as_it_did(name: str) -> None:
    options, attempts = STORIES[name]
    belief, moves = make_controller("belief", LIMITS, **options), []
    assert isinstance(belief, Belief)
    for number, shown in enumerate(attempts, 1):
        move: list[Any] = []
        if shown is None:
            belief.blocked_without_evidence()
        else:
            command = belief.decide(shown, number)
            assert isinstance(command, Command)
            move = [command.dx_mm, command.dtheta_deg, command.reason]
        hypotheses = np.ravel(belief.grid.layers.sum((2, 3)))
        moves.append([*move, belief.grid.enters(), *hypotheses, *np.ravel(belief.grid.moments())])
    is_as_kept(__file__, f"belief: {name}", moves)


FOLLOWED = {
    **{f"good {number}": steps for number, steps in enumerate(GOOD)},
    "reversed": REVERSED,
    "far off": [
        ((17.0, 3.0), (0.9, 2.0), (-9.0, 1.0)),
        ((3.0, 15.0), BLIND, (2.0, -6.0)),
        ((-9.0, 0.4), (6.0, 8.0), (1, 1)),
    ],
    "sure once": [
        ((6.0, 4.0), (0.8, 1.5), (-6.0, -4.0)),
        ((0.2, 0.3), (2.3, 4.9), (0.5, 1.0)),
        ((1, 1), BLIND, (0, 1)),
    ],
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_each_wiring_explains_the_same_estimates_as_well_as_it_did(name: str) -> None:
    consistency, explained = Consistency(), []
    for here, sigma, move in FOLLOWED[name]:
        try:
            consistency.add(correction(here, sigma, move).estimate, turned_pair())
            answer = ""
        except Refusal as refusal:
            answer = str(refusal)
        consistency.move(correction(here, sigma, move))
        explained.append([answer, *(followed.log_evidence for followed in consistency._followed.values())])
    is_as_kept(__file__, f"consistency: {name}", explained)


def test_turns_are_told_from_the_same_size_on() -> None:
    """In steps of 0.05 deg, of 0.02 deg where a turn is expected to stay."""
    turns_deg = np.arange(0.05, 1.2, 0.05)
    answers = {
        "hangs": [bool(hangs_turned(hanging(turn))[1]) for turn in turns_deg],
        "went in": [bool(turned_going_in(last(math.radians(turn)), None)[1]) for turn in turns_deg],
        "around": [hangs_turned(hanging(0.9, around))[1] for around in (0.0, 0.1, 0.2, 0.3, 0.5)],
        "lasts": [
            lasting_turn_deg(last(turn, share * turn), FREE) for turn in (0.02, -0.05) for share in (0.1, 0.4, 0.9)
        ],
        "one-sided": [one_sided(turned_pair(left, 1.0)) for left in np.arange(0.05, 2.0, 0.05)],
        "one-sided, small": [one_sided(turned_pair(left, 0.9 * left)) for left in np.arange(0.05, 2.0, 0.05)],
    }
    is_as_kept(__file__, "turns", answers)


def test_full_depth_is_doubted_from_the_same_values_on() -> None:
    changes: dict[str, list[Any]] = {
        "depth_mm": [23.6, 23.9, 24.1, 24.5],
        "gripper_width_mm": [48.5, 48.9, 49.1, 50.9, 51.1],
        "stopped_ns": [int(seconds * 1e9) for seconds in (0.08, 0.09, 0.11, 0.2, 2.7, 2.9)],
    }
    doubted = {name: [reasons(descent(**{name: value})) for value in values] for name, values in changes.items()}
    doubted["bulge"] = [reasons(with_bulge(left)) for left in (0.2, 0.9, 0.98, 1.02)]
    followed = [blocked(0.5, grip_mm, 240.0) for grip_mm in np.arange(0.2, 2.0, 0.2)]
    is_as_kept(__file__, "claim", doubted | {"slid": [slid(attempt) for attempt in followed]})


def with_bulge(left: float) -> Any:
    attempt = descent()
    attempt.ring.append(pair(left=left))
    return attempt


def slid(attempt: Any) -> list[float]:
    from service.decision.claim import pressed_mm, slid_mm, went_mm_s

    onset = replace(attempt, onset_ns=int(0.45e9))
    return [slid_mm(attempt), went_mm_s(attempt), pressed_mm(onset)]


JOBS = {
    "taken afresh": Job("rectangle", 0, 9.0, 4.0, 3, "belief", "fields", given_reach=True),
    "goes in": Job("circle", 0, -5.0, -3.0, 4, "belief", "fields"),
}
NOTED: dict[str, tuple[str, ...]] = {
    "armed": ("reference_seq",),
    "refused": ("reason", "detail"),
    "slip": ("finger", "frame_seq", "score", "reason"),
    "enough": ("frame_seq", "pressed_mm"),
    "correction": ("dx_mm", "dtheta_deg", "class_probabilities", "estimate", "confidence", "turns_deg", "reason"),
    "no_decision": ("reason", "detail"),
    "fault": ("code", "detail"),
    "finished": ("outcome", "cause", "doubts"),
}


@pytest.mark.parametrize("name", JOBS)
def test_a_simulated_insertion_is_answered_as_it_was(name: str) -> None:
    """By the released networks; onset, order to stop, decision, what stays of a turn, and the claim."""
    insertion, answers = stage(JOBS[name], models_of(MODELS)), list[Any]()
    hear = insertion._hear

    def listen(messages: list[wire.ServiceMessage]) -> None:
        for message in messages:
            if message.type in NOTED:
                content = message.model_dump(mode="json")
                answers.append([message.type, *(content[field] for field in NOTED[message.type])])
            if message.type in {"armed", "refused"} and insertion.session.decider:
                grasp = insertion.session.decider.grasp
                answers.append([grasp.tilt.deg, grasp.blocked_pitch, grasp.pressed_mm])
        hear(messages)

    insertion._hear = listen  # type: ignore[method-assign]
    insertion.run()
    is_as_kept(__file__, f"insertion: {name}", answers)
