"""A grasp is open, touched, held, slipping, lost; one finger alone, or half a touch, is no loss."""

import numpy as np
import pytest

from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.open_gel import OpenGel, shrunk
from service.perception.slip.phases import Grasp, GraspPhases
from tests.service.perception.synthetic import FRAME_NS, draw, grid


def story(rows, slips=()):
    phases = GraspPhases()
    return [phases.update(list(row), slips=k in slips) for k, row in enumerate(rows)]


HELD = [(0.3, 0.2)] * 3 + [(3.0, 2.0)] * 8


def test_an_emptied_hand_is_lost_within_three_frames():
    phases = story([*HELD, *[(0.4, 0.3)] * 4])
    assert phases[:3] == ["open"] * 3
    assert phases[3] == "contact"
    assert phases[10] == "hold"
    assert phases.index("lost") - 11 <= 2


def test_one_finger_that_lets_go_is_no_loss():
    assert "lost" not in story([*HELD, *[(0.4, 2.0)] * 30])
    assert "lost" not in story([*HELD, *[(None, 2.0)] * 30])
    assert "lost" not in story([*HELD, *[(None, None)] * 30])


@pytest.mark.parametrize(("blind_n", "loses"), [(7, False), (8, True)])
def test_a_finger_that_is_not_visible_for_eight_frames_has_no_say(blind_n, loses):
    """It has none from the eighth on; the other one is empty in that frame and the next."""
    unseen = [(None, 2.0)] * (blind_n - 1)
    assert ("lost" in story([*HELD, *unseen, *[(None, 0.2)] * 2])) == loses


def test_a_touch_that_becomes_weaker_is_no_loss_until_it_is_gone():
    weaker = [(3.0 * share, 2.0 * share) for share in np.linspace(1, 0.55, 20)]
    assert "lost" not in story([*HELD, *weaker])


@pytest.mark.parametrize(("weak_n", "loses"), [(14, True), (15, False)])
def test_a_touch_is_gone_beside_the_usual_one_of_the_last_thirty_frames(weak_n, loses):
    """Of thirty frames fifteen are as weak: half of the usual touch is then less than what is left."""
    story_so_far = [(1.9, 1.9)] * 40 + [(1.0, 1.0)] * weak_n
    assert ("lost" in story([*story_so_far, (0.9, 0.9), (0.9, 0.9)])) is loses


def test_one_empty_frame_is_no_loss():
    assert "lost" not in story([*HELD, (0.2, 0.2), *[(3.0, 2.0)] * 5, (0.2, 0.2), *[(3.0, 2.0)] * 5])


def test_slip_counts_only_of_something_held():
    assert "slip" not in story([(0.3, 0.2)] * 10, slips=range(10))
    assert story(HELD, slips=[9])[9] == "slip"


def test_an_object_regrasped_is_held_again():
    assert story([*HELD, *[(0.3, 0.2)] * 3, *[(3.0, 2.0)] * 8])[-1] == "hold"


def test_a_light_touch_that_trembles_is_no_loss():
    assert "lost" not in story([*[(0.2, 0.2)] * 3, *[(1.2, 0.3), (1.1, 0.3), (0.9, 0.3), (0.8, 0.3)] * 8])


def test_each_finger_has_phases_of_its_own():
    grasp = Grasp(2)
    for left, right in [*HELD, *[(0.2, 2.0)] * 4]:
        grasp.update([left, right], [False, False])
    assert [finger.phase for finger in grasp.fingers] == ["lost", "hold"]
    assert grasp.whole.phase == "hold"


@pytest.mark.parametrize("seed", range(3))
def test_an_open_gel_is_untouched_under_noise_and_exposure_and_touched_by_markers_or_shade(seed):
    rng = np.random.default_rng(seed)
    rest = grid(jitter=0.4)
    tracker, gel = MarkerTracker(), OpenGel()
    pictures = [draw(rest, rng), draw(rest, rng), draw(rest, rng)]
    pictures[1] = (pictures[1] * 0.9).astype(np.uint8)
    shaded = pictures[2].astype(int)
    shaded[100:180, 100:180] += np.array([14, 0, -14])
    away = (rest - rest.mean((0, 1))) / 50.0
    bulged = rest + 2.5 * away * np.exp(0.5 - 0.5 * np.square(away).sum(-1, keepdims=True))
    pictures += [np.clip(shaded, 0, 255).astype(np.uint8), draw(bulged, rng)]
    fields = [tracker.update(picture, k * FRAME_NS) for k, picture in enumerate(pictures)]
    shades = [shrunk(picture) for picture in pictures]
    gel.learn(fields[0], shades[0])
    touches = [gel.touch(field, picture) for field, picture in zip(fields, shades, strict=True)]
    assert max(touches[:3]) < 1
    assert min(touches[3:]) > 1
    assert gel.shade(shrunk((pictures[2] * 0.5).astype(np.uint8))) is None, "an exposure never seen decides nothing"
