"""An untouched gel is recognised from images alone, and a held object is never called untouched."""

from dataclasses import replace

import numpy as np
import pytest

from service.perception.markers.field import MarkerField, empty_field
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.detector import SlipDetector
from service.perception.slip.grasp import GraspWatch
from service.perception.slip.open_gel import HOME_PITCH, WEIGHT_PITCH, OpenGel, changed_grey, shrunk, spanned
from simulation.optics.renderer import Appearance, Renderer
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.worlds import load_scene, object_names
from tests.service.perception.synthetic import FRAME_NS, draw, grid

FREE = np.zeros((20, 21, 3), np.float32)


def tracked(renderer, gels, seed=0):
    tracker = MarkerTracker()
    return [tracker.update(renderer.rectified(gel, seed + k), k * FRAME_NS) for k, gel in enumerate(gels)]


def bulged(points, px):
    """The grid carried outwards around its middle by up to ``px``, as rubber under a pressed fingertip."""
    way = (points - points.mean((0, 1))) / 60.0
    return points + px * 1.6 * way * np.exp(0.5 - 0.5 * np.square(way).sum(-1, keepdims=True))


@pytest.mark.parametrize("name", object_names())
def test_a_simulated_finger_knows_from_its_picture_whether_it_holds_something(name):
    scene = load_scene(name, camera__noise_grey=6.0, grasp__force_n=0.6 * load_scene(name).grasp.force_n)
    cell = QuasiStaticCell(scene, 1)
    cell.regrasp(3.0, 2.0)
    renderer = Renderer(Appearance.draw(scene, "left", 5))
    held, free = (tracked(renderer, [gel])[0] for gel in (cell.look().gel[0], FREE))
    assert OpenGel().mark(held) is held
    marked = OpenGel().mark(free)
    assert marked.contact is not None
    assert not marked.contact.any()
    detector = SlipDetector()
    assert detector.rearm(marked).state == "no_contact"
    assert not detector.armed
    assert detector.rearm(OpenGel().mark(held)).state == "hold"


def test_a_gel_printed_unevenly_is_free_only_against_a_frame_that_shows_it_free():
    rng = np.random.default_rng(1)
    rest = grid(jitter=0.5)
    tracker = MarkerTracker()
    fields = [
        tracker.update(draw(p, rng), k * FRAME_NS) for k, p in enumerate([rest, rest, bulged(rest, 1.5), rest + 0.05])
    ]
    free = OpenGel()
    assert all(free.mark(field) is field for field in fields), "what is not known is left open"
    free.learn(fields[0])
    assert [free.mark(field).contact is not None for field in fields] == [True, True, False, True]
    with pytest.raises(ValueError, match="without markers"):
        free.learn(empty_field(0, "no_grid", "black"))


def test_half_a_picture_says_nothing():
    rng = np.random.default_rng(2)
    field = MarkerTracker().update(draw(grid(jitter=0.0), rng), 0)
    assert OpenGel().mark(field).contact is not None
    assert OpenGel().mark(replace(field, valid=field.valid & (np.arange(21) < 9))).contact is None
    assert OpenGel().mark(replace(field, status="lost")).contact is None


def test_a_watch_goes_from_no_contact_over_grasping_to_hold_and_back():
    scene = load_scene("circle")
    cell = QuasiStaticCell(scene, 1)
    cell.regrasp(3.0, 2.0)
    held = cell.look().gel[0]
    closing = [FREE] * 20 + [held * np.float32(share) for share in np.linspace(0.2, 1.0, 5)]
    gels = closing + [held] * 20 + [FREE] * 20
    watch = GraspWatch()
    states = [watch.update(field) for field in tracked(Renderer(Appearance.draw(scene, "left", 5)), gels)]
    assert {state.state for state in states[:20]} == {"no_contact"}
    assert states[24].state == "grasping"
    assert states[44].state == "hold"
    assert states[45].state == "release"
    assert states[45].stop
    assert {state.state for state in states[46:]} == {"no_contact"}
    assert not any(state.slip for state in states)


def test_a_weight_is_what_all_markers_hang_down_by_from_where_they_were():
    gel, rng, points = OpenGel(), np.random.default_rng(3), grid()
    fields = [MarkerTracker().update(draw(points + np.array([0.0, by]), rng), FRAME_NS) for by in (0.0, 0.3, -0.3)]
    assert gel.weight(fields[0]) is None, "no open gel was learnt"
    gel.learn(fields[0])
    down, up = (gel.weight(field) for field in fields[1:])
    expected = 0.3 / (WEIGHT_PITCH * fields[0].pitch_px)
    assert down == pytest.approx(expected, rel=0.2)
    assert up == pytest.approx(-expected, rel=0.2)
    assert gel.weight(empty_field(FRAME_NS, "lost", "no marker")) is None


@pytest.mark.parametrize("learnt", [False, True])
def test_without_a_picture_now_or_then_a_touch_is_what_the_markers_show(learnt):
    rng, points = np.random.default_rng(4), grid(jitter=0.0)
    pictures = [draw(points, rng), draw(bulged(points, 1.5), rng)]
    tracker, gel = MarkerTracker(), OpenGel()
    fields = [tracker.update(picture, k * FRAME_NS) for k, picture in enumerate(pictures)]
    gel.learn(fields[0], shrunk(pictures[0]) if learnt else None)
    shown = None if learnt else shrunk(pictures[1])
    assert gel.touch(fields[1], shown) == gel.bulge(fields[1])
    assert gel.touch(fields[1], shown) > 1.0


REST = grid(jitter=0.4).astype(np.float32)


def shown(moved_px, valid=None):
    there = np.ones(REST.shape[:2], bool) if valid is None else valid
    return MarkerField(REST, np.broadcast_to(np.float32(moved_px), REST.shape), there, None, 15.0, 0)


def learnt(picture=None):
    gel = OpenGel()
    gel.learn(shown((0.3, -0.2)), picture)
    return gel


def test_a_bulge_is_the_displacement_of_the_markers_but_for_the_worst_twentieth():
    moved = np.tile(np.float32([0.3, -0.2]), (20, 21, 1))
    moved[:, :10] += (0.2, 0.0)
    worst = moved.copy()
    worst.reshape(-1, 2)[-21:] += 40.0
    expected = np.sqrt(0.2**2 * 190 / 399) / (HOME_PITCH * 15.0)
    assert learnt().bulge(shown(worst)) == pytest.approx(expected, rel=1e-3)
    worst.reshape(-1, 2)[-22:] += 40.0
    assert learnt().bulge(shown(worst)) > 10 * expected


@pytest.mark.parametrize(("found_n", "known"), [(251, False), (252, True)])
def test_a_gel_is_compared_by_three_fifths_of_its_markers(found_n, known):
    there = np.arange(420).reshape(20, 21) < found_n
    assert (learnt().bulge(shown((0.3, -0.2), there)) is not None) is known
    hidden = OpenGel()
    hidden.learn(shown((0.0, 0.0), there))
    assert (hidden.bulge(shown((0.0, 0.0))) is not None) is known, "then, too"
    small = MarkerField(REST[:4, :3], REST[:4, :3] * 0, np.arange(12).reshape(4, 3) < found_n - 240, None, 15.0, 0)
    assert (OpenGel().bulge(small) is not None) is known, "and by twelve at least"


@pytest.mark.parametrize(("gain", "known"), [(1.28, True), (1.32, False), (1 / 1.28, True), (1 / 1.32, False)])
def test_a_picture_is_compared_in_light_up_to_three_tenths_brighter_or_so_much_darker(gain, known):
    even = np.full((80, 80, 3), 100.0, np.float32)
    assert changed_grey(even * np.float32(gain), spanned(even), 0.02) == (
        pytest.approx(0.0, abs=1e-3) if known else None
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_a_picture_has_changed_beyond_the_range_around_each_pixel_but_for_the_worst_part(channel, side):
    """A fiftieth of it: 128 of 6,400 pixels."""
    rough = np.random.default_rng(0).uniform(90, 110, (80, 80, 3)).astype(np.float32)
    open_gel, moved = spanned(rough), np.roll(rough, (1, -1), (0, 1))
    moved[0], moved[:, -1] = rough[0], rough[:, -1]
    assert changed_grey(moved, open_gel, 0.02) == pytest.approx(0.0, abs=0.5), "each lies within its old neighbours"
    for changed_n, counts in ((127, False), (128, True)):
        pressed = rough.copy()
        flat = pressed.reshape(-1, 3)
        reach = (open_gel.high if side > 0 else open_gel.low).reshape(-1, 3)
        flat[3000 : 3000 + changed_n, channel] = reach[3000 : 3000 + changed_n, channel] + side * 30.0
        changed = changed_grey(pressed, open_gel, 0.02)
        assert changed == pytest.approx(30.0 if counts else 0.0, abs=2.0)


def test_a_touch_is_the_stronger_of_shade_and_worn_markers_and_the_shade_where_they_were_mistaken():
    even = np.full((80, 80, 3), 100.0, np.float32)
    shaded = even.copy()
    shaded[10:40, 10:40] += 9.0
    gel = learnt(even)
    assert gel.touch(shown((0.3, -0.2)), shaded) == pytest.approx(2.0)
    assert gel.touch(shown((0.3 + 0.06 * 15, -0.2)), even) == pytest.approx(1.0, rel=1e-3)
    assert gel.touch(shown((0.3 + 0.45 * 15, -0.2)), even) == pytest.approx(7.5, rel=1e-3)
    assert gel.touch(shown((0.3 + 0.55 * 15, -0.2)), even) == 0.0, "taken for their neighbours"
    assert gel.touch(shown((0.3 + 0.45 * 15, -0.2)), 1.4 * even) is None, "in a light never seen"
