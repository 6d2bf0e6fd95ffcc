"""The same marker fields give the same states, scores and motions as they did: no fitted limit moves unnoticed."""

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from service.perception.markers.field import MarkerField
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.imprint import ImprintWatch
from service.perception.slip.onset import OnsetDetector
from service.perception.slip.open_gel import OpenGel, shrunk
from service.perception.slip.phases import Grasp
from service.perception.slip.rigid import carried_px, fit_motion, moving_patch, refine
from service.perception.slip.state import SlipSettings
from tests.kept import is_as_kept
from tests.service.perception.slip.test_detector import shaken, straight_slide
from tests.service.perception.slip.test_grasp import renumbered
from tests.service.perception.slip.test_imprint import PERIOD_NS, STILL, picture, scores
from tests.service.perception.synthetic import FRAME_NS, draw, grid, patch_fields, pressed, rigid


def patch(*motion: Any, **options: Any) -> list[MarkerField]:
    return patch_fields(rigid(*motion), **options)[0]


def blinking() -> list[MarkerField]:
    """A patch that slips while a finger shows nothing at times, and nothing more in the end."""
    fields = patch((0.5, 1.0), 0.4, hold_px=9, frames=24)
    nothing = np.zeros_like(fields[0].valid)
    for k in (5, 6, *range(14, 24)):
        fields[k] = replace(fields[k], status="lost" if k > 13 else "no_grid", valid=nothing)
    fields[8] = replace(fields[8], status="duplicate")
    return fields


def worn() -> list[MarkerField]:
    """Half of the markers are gone, others come and go."""
    rng = np.random.default_rng(4)
    fields = patch((0.2, 1.2), 0.6, hold_px=11, frames=18, noise_px=0.15, seed=4)
    gone = rng.random(fields[0].valid.shape) < 0.4
    return [replace(one, valid=~gone & (rng.random(gone.shape) < 0.9)) for one in fields]


def grown() -> list[MarkerField]:
    return patch_fields(lambda k, rest: (rest - (150, 140)) * 0.006 * k + np.array([0.0, 0.3 * k]), frames=20)[0]


def shrinking() -> list[MarkerField]:
    return patch_fields(lambda k, rest: (rest - (150, 140)) * -0.004 * k, frames=14)[0]


STORIES: dict[str, Callable[[], list[MarkerField]]] = {
    "sticks and turns": lambda: patch((0.8, 1.0), 1.5, frames=14),
    "slips": lambda: patch((0, 1.5), 0.7, hold_px=14),
    "slips, contact known": lambda: patch((1.0, 1.0), 0.7, hold_px=14, contact_known=True),
    "slips sideways under noise": lambda: patch((1.5, 0), -0.5, hold_px=8, noise_px=0.2, seed=3),
    "far": lambda: patch((0, 4.0), 0.0, frames=12),
    "turns far": lambda: patch((0, 0.2), 2.5, frames=10),
    "slides straight": lambda: straight_slide(0.3),
    "shaken": lambda: shaken(1),
    "blinks": blinking,
    "worn": worn,
    "grows": grown,
    "shrinks": shrinking,
    "a small grid": lambda: patch((0, 1.0), 0.4, rows=7, cols=9, half=(60.0, 45.0), centre=(60.0, 45.0), hold_px=8),
}


@pytest.mark.parametrize("name", STORIES)
def test_a_story_of_fields_is_read_as_it_was(name: str) -> None:
    fields, detector, onset, watch = STORIES[name](), SlipDetector(), OnsetDetector(), GraspWatch()
    detector.rearm(fields[0])
    onset.rearm(fields[0])
    read, stamps_ns = [], [field.captured_ns for field in fields[1:]]
    for field in fields[1:]:
        state, began_ns = detector.update(field), onset.update(field)
        nodes = [int(state.slipping.sum()), int(state.sticking.sum()), float(np.abs(state.residual_px).sum())]
        moved = [*state.shift_px, state.angle_rad, state.scale]
        began_n = -1 if began_ns is None else stamps_ns.index(began_ns)
        read.append([state.state, state.stop, state.score, *nodes, *moved, began_n, watch.update(field).state])
    is_as_kept(__file__, f"fields: {name}", read)


def test_motions_of_points_are_fitted_as_they_were() -> None:
    rng, fits = np.random.default_rng(5), []
    points = rng.uniform(0.0, 120.0, (40, 2))
    for scale in (False, True):
        moved = (
            1.03 * points @ np.array([[0.995, 0.0998], [-0.0998, 0.995]]) + (4.0, -2.0) + rng.normal(0, 0.3, (40, 2))
        )
        moved[:12] = points[:12] + rng.normal(0, 0.2, (12, 2))
        start = fit_motion(points, moved, rng.uniform(0.1, 1.0, 40), 15.0, scale=scale)
        refined = refine(points, moved, start, np.ones(40), 0.6, 15.0, scale=scale)
        fits.append([[one.angle_rad, one.scale, *one.shift_px, *one.pivot_px] for one in (start, refined)])
    thin = [np.stack([np.arange(8) * 15.0, rng.normal(0, spread, 8)], -1) for spread in (2.0, 4.0, 6.0, 8.0)]
    fits.append([fit_motion(line, line, np.ones(8), 15.0, scale=False) is None for line in thin])
    for fields in (patch((0.6, 1.4), 0.8, hold_px=8, frames=12), worn()):
        rest = fields[0].rest_px.astype(np.float64)
        after = rest + fields[-1].displacement_px
        moving = moving_patch(rest, after, fields[-1].valid, 0.45, 15.0)
        carried = carried_px(fields[-1].displacement_px.astype(np.float64), fields[-1].valid)
        fits.append([moving.angle_rad, *moving.shift_px, *moving.pivot_px, carried])
    is_as_kept(__file__, "motions", fits)


def test_a_watched_grasp_is_read_as_it_was() -> None:
    parts = [patch(frames=20), patch((0, 1.0), 0.3, frames=8, seed=2)]
    held = patch_fields(pressed(rigid()), frames=16, seed=6)[0]
    sliding = patch_fields(pressed(rigid((0, 1.5), 0.7)), hold_px=10, seed=3)[0]
    watch = GraspWatch()
    states = [watch.update(field) for field in renumbered(*parts, held, sliding, held, patch(frames=20))]
    is_as_kept(__file__, "grasp", [[one.state, one.score, one.reason] for one in states])


@pytest.mark.parametrize("height", [0.4, 1.0, 2.0])
def test_an_imprint_changes_by_as_much_as_it_did(height: float) -> None:
    walk, rng, tracker, watch = (
        [*STILL[:3], 2.0, 5.0, 9.0, 9.0],
        np.random.default_rng(3),
        MarkerTracker(),
        ImprintWatch(),
    )
    changes = []
    for k, way in enumerate(walk):
        image = picture(rng, way, 0.3 * way, height * (1.0 - 0.05 * k))
        stamp_ns = k * PERIOD_NS + (700_000_000 if k > 5 else 0)  # the last one comes after a gap
        change = watch.update(image, tracker.update(image, stamp_ns))
        changes.append(
            []
            if change is None
            else [change.changed, change.changed_later, change.let_go, change.relief, change.irregular_pitch]
        )
    slides = [score if score is not None else [] for score in scores(walk, [0.0] * len(walk), height)]
    is_as_kept(__file__, f"imprint: {height}", [changes, slides])


def test_a_gel_is_touched_by_as_much_as_it_was() -> None:
    rng, tracker, rest = np.random.default_rng(1), MarkerTracker(), grid(jitter=0.2)
    away = (rest - rest.mean((0, 1))) / 50.0
    touches: list[Any] = []
    learnt, guessed = OpenGel(), OpenGel()
    for k, bulge in enumerate((0.0, 0.0, 0.3, 1.0, 3.0)):
        light = 140.0 * (1.0, 1.1, 0.95, 1.0, 1.35)[k]
        image = draw(
            rest + bulge * away * np.exp(-np.square(away).sum(-1, keepdims=True)) + (0, 0.05 * k), rng, light=light
        )
        shaded = image.astype(int)
        shaded[100:180, 100:180] += np.array([2, 0, -3]) * k
        small = shrunk(np.clip(shaded, 0, 255).astype(np.uint8))
        field = tracker.update(image, k * FRAME_NS)
        if k == 0:
            learnt.learn(field, small)
        touches.append([learnt.touch(field, small), learnt.shade(small), learnt.bulge(field), learnt.weight(field)])
        touches.append([guessed.touch(field), guessed.mark(field).contact is None])
    is_as_kept(__file__, "open gel", touches)


def test_phases_of_a_grasp_follow_the_same_touches_as_they_did() -> None:
    rng, grasp = np.random.default_rng(2), Grasp(2)
    level = np.repeat(rng.choice([0.2, 0.7, 0.95, 1.05, 1.5, 3.0], 60), 3)
    phases = []
    for k, touch in enumerate(level):
        touches = [float(touch), None if k % 17 == 0 else float(touch * rng.uniform(0.5, 1.4))]
        slips = [bool(rng.random() < 0.15), False]
        phase = grasp.update(touches, slips, slides=None if k % 5 else bool(k % 2))
        phases.append([phase, *(finger.phase for finger in grasp.fingers)])
    is_as_kept(__file__, "phases", phases)


def test_what_ships_stays() -> None:
    is_as_kept(__file__, "shipped", asdict(SlipSettings()))
