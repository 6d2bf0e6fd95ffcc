"""Hard presses for the released networks that read depth: rates, reaches, standstill, late frames, lost markers."""

from dataclasses import replace
from typing import Any

import numpy as np

from export.onnx.golden import hard_input
from export.onnx.model import geometry_inputs, steps
from service.contract.model_card import CONDITIONS
from service.decision.evidence import DecisionRun, Refusal
from service.decision.models import load_models
from service.perception.markers.field import MarkerField
from tests.hard_cases.instead import waved_through
from tests.hard_cases.presses import FOLDERS, SENSOR, TOUCH_MM, Answer, Press
from tests.hard_cases.registry import ROOT, Guard, case, not_refused
from tests.hard_cases.rooms.networks import IMPOSSIBLE, LARGEST, STEPS, golden, largest_of, released

PITCH_MM, MOST_REACH_MM = SENSOR.marker_pitch_mm, 100.0  # the most that a client can state
OUTSIDE = "out_of_distribution"


def _not_refused(presses: list[Press], reason: str, words: str) -> float:
    """How many presses end otherwise than in a refusal for this reason, in these words."""
    answers: list[Any] = [press.answer(folder) for press in presses for folder in FOLDERS]
    return float(sum(not (getattr(a, "reason", "") == reason and words in getattr(a, "detail", "")) for a in answers))


def _sigmas(press: Press, usual: Press) -> float:
    """How far two presses are estimated apart, in standard deviations; infinite if one has no correction."""
    return max(_apart(press.answer(folder), usual.answer(folder)) for folder in FOLDERS)


def _apart(one: Answer, other: Answer) -> float:
    if one.type != "correction" or other.type != "correction" or not (one.estimate and other.estimate):
        return np.inf
    here, there = one.estimate, other.estimate
    in_x, in_theta = here.dx_mm - there.dx_mm, here.dtheta_deg - there.dtheta_deg
    return max(abs(in_x) / (there.sigma_x_mm or 0.0), abs(in_theta) / (there.sigma_theta_deg or 0.0))


@case(
    "networks",
    why="a condition is read as the logarithm of a ratio, and a share divides by the reach",
    holds="conditions a hundredth to a hundred times the usual, and unknown, give finite, bounded outputs: largest",
    guard="training.networks.pressing:PressingNetwork.advance",
    limit=LARGEST,
)
def conditions_far_from_training(seed: int) -> float:
    worst = 0.0
    for name in STEPS:
        model, fields = released(name), golden(seed, name)[None]
        usual = geometry_inputs(model.card, 1)["conditions"]
        for place in range(len(CONDITIONS)):
            for share in (0.0, 1e-2, 1e2):
                stated = usual.copy()
                stated[:, place] *= share
                worst = max(worst, *map(largest_of, steps(model, fields, fields.shape[1], {"conditions": stated})))
    return worst


@case(
    "networks",
    why="a gel that slides at a hundredth of a marker pitch, or bears a hundred, is like none of training",
    holds="a shear reach of 0.01 or 100 pitches is refused by name before the arm goes down: not refused",
    guard=Guard("service.contract.model_card:Pressing.outside", "every condition counts as trained", waved_through),
)
def shear_reach_told_as_0_01_and_100_pitches(seed: int) -> float:
    least, beyond, most = (Press(seed, reach_mm=mm) for mm in (0.01 * PITCH_MM, 100.0 * PITCH_MM, MOST_REACH_MM))
    refused = not_refused([lambda folder=one: beyond.answer(folder) for one in FOLDERS], ValueError, "shear_reach_mm")
    return refused + _not_refused([least, most], "untrained", "shear_reach_mm")


@case(
    "networks",
    why="at 5 fps the arm goes on by 2 mm from frame to frame, at 200 fps by less than a gel's noise",
    holds="frames further apart or closer than in training are refused by name: not refused",
    guard=Guard("service.decision.network_input:check_trained", "every spacing counts as trained", waved_through),
)
def frames_too_far_apart_and_too_close(seed: int) -> float:
    presses = [Press(seed, fps=5.0, speed_mm_s=10.0), Press(seed, fps=200.0, speed_mm_s=3.0)]
    return _not_refused(presses, OUTSIDE, "frame_spacing_mm")


@case(
    "networks",
    why="a press is four frames at 5 fps and fifty at 200, and begins between two of them",
    holds="the networks are shown the same press: sigmas between the estimates, against 30 fps",
    guard=Guard(
        "service.perception.pressing:onset_depth",
        "it begins with the first frame that shows it",
        lambda _: lambda depths_mm, _moved, first: float(depths_mm[first]),
    ),
    limit=0.5,
)
def presses_at_5_and_200_fps(seed: int) -> float:
    slow, quick = (Press(seed, speed_mm_s=speed_mm_s) for speed_mm_s in (3.0, 10.0))
    return max(_sigmas(replace(slow, fps=5.0), slow), _sigmas(replace(quick, fps=200.0), quick))


@case(
    "networks",
    why="the depth of a picture follows from its stamp, and an arm that stands makes it wrong",
    holds="a standstill in the press is refused by name: not refused",
    guard=Guard(
        "service.decision.attempt:Attempt.paused_in_press", "nothing is known of pauses", property(lambda _: False)
    ),
)
def standstill_in_the_press(seed: int) -> float:
    presses = [Press(seed, stands=(TOUCH_MM + 0.4, stood_s)) for stood_s in (0.04, 0.1, 0.5)]
    return _not_refused(presses, "stale", "paused")


@case(
    "networks",
    why="an arm that waits above the block is as late in every picture after",
    holds="a standstill before the touch changes no estimate: sigmas apart",
    guard=Guard(
        "service.decision.attempt:Attempt.paused_in_press", "every pause is in a press", property(lambda _: True)
    ),
    limit=0.1,
)
def standstill_before_the_touch(seed: int) -> float:
    return _sigmas(Press(seed, stands=(TOUCH_MM - 0.1, 0.4)), Press(seed))


@case(
    "networks",
    why="a late frame's depth lies before those that were read, and a mean over depth needs them in order",
    holds="frames with the stamp of the first, torn off, leave the estimates as they are: sigmas apart",
    guard=Guard(
        "service.session.fingers:Fingers._overtaken", "a frame may follow newer ones", lambda _: lambda *_: False
    ),
)
def stamps_going_backwards_in_the_press(seed: int) -> float:
    return _sigmas(Press(seed, late=True), Press(seed))


def one_marker(field: MarkerField, pressed_mm: float) -> MarkerField:
    """All markers but one are lost in the press."""
    valid = np.zeros_like(field.valid)
    valid[10, 10] = True
    return replace(field, valid=valid, status="partial") if pressed_mm > 0.0 else field


@case(
    "networks",
    why="one marker is a place without a shape, and a mean over those seen is itself",
    holds="a press that shows one marker of a finger is refused as strange: not refused",
    guard=Guard("service.decision.evidence:check_strangeness", "no motion is strange", waved_through),
)
def one_marker_left_in_the_press(seed: int) -> float:
    presses = [Press(seed, marked=marked) for marked in ((one_marker, None), (None, one_marker))]
    return _not_refused(presses, OUTSIDE, "strangeness")


@case(
    "networks",
    why="a network answers whatever it is asked, and confidently",
    holds="motions that no press makes are refused as strange by those that read steps: not refused",
    guard=Guard("service.decision.evidence:check_strangeness", "any motion will do", waved_through),
)
def motions_that_no_press_makes(_seed: int) -> float:
    missed = 0.0
    for folder in FOLDERS:
        models = load_models(ROOT / "models" / folder)
        for name in IMPOSSIBLE:
            pairs = hard_input(models.card)[name]
            run = DecisionRun(models, pairs[0], 56.0)
            for pair in pairs:
                run.step(pair)
            missed += not_refused([run.evidence], Refusal, "strangeness")
    return missed
