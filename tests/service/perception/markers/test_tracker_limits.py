"""What a frame needs to be evidence, on both sides of each limit."""

import numpy as np
import pytest

from service.perception.markers.tracker import MarkerTracker
from tests.service.perception.synthetic import FRAME_NS, draw, grid

REST = grid()


def after(image: np.ndarray, rng: np.random.Generator):
    """The field of a picture that follows one of the whole grid at rest."""
    tracker = MarkerTracker()
    tracker.update(draw(REST, rng), 0)
    return tracker.update(image, FRAME_NS)


@pytest.mark.parametrize(("found_n", "status"), [(83, "lost"), (84, "partial"), (251, "partial"), (252, "tracking")])
def test_below_a_fifth_of_the_markers_a_grid_is_lost_and_below_three_fifths_partial(found_n, status):
    rng, there = np.random.default_rng(3), np.zeros(REST.shape[:2], bool)
    there[4:].flat[:found_n] = True
    field = after(draw(REST[there], rng), rng)
    assert field.status == status
    assert np.array_equal(field.valid, there & (status != "lost"))


@pytest.mark.parametrize(("changed_n", "status"), [(75, "duplicate"), (76, "tracking")])
def test_a_frame_repeats_the_one_before_below_a_two_hundredth_of_a_grey_level(changed_n, status):
    """On average over every seventh row: 46 of 327 px, in three colours."""
    image = draw(REST, np.random.default_rng(0))
    tracker, other = MarkerTracker(), image.copy()
    other[0, :changed_n] += 1
    tracker.update(image, 0)
    assert tracker.update(other, FRAME_NS).status == status


@pytest.mark.parametrize(
    ("share", "others_n", "counts"), [(0.28, 419, False), (0.33, 419, True), (0.28, 260, False), (0.2, 150, True)]
)
def test_a_marker_of_three_tenths_of_the_usual_contrast_is_found(share, others_n, counts):
    """Where fewer than half are in sight, what is usual is not known."""
    rng, there = np.random.default_rng(3), np.zeros(REST.shape[:2], bool)
    there[0 if others_n > 400 else 4 :].flat[: others_n + 1] = True
    there[10, 10] = False
    faint = draw(REST[10, 10], rng, contrast=90 * share, noise=0)
    field = after(np.minimum(draw(REST[there], rng, noise=0), faint), rng)
    assert field.valid[there].all()
    assert field.valid[10, 10] == counts


@pytest.mark.parametrize(("up_px", "counts"), [(0.3, True), (0.7, False)])
def test_a_marker_cut_by_the_border_counts_unless_it_was_carried_there(up_px, counts):
    """By more than a tenth of its diameter."""
    rng, tracker = np.random.default_rng(5), MarkerTracker()
    low = REST - np.array([0.0, REST[0, :, 1].mean() - 3.6])
    tracker.update(draw(low, rng, noise=0.5), 0)
    field = tracker.update(draw(low - np.array([0.0, up_px]), rng, noise=0.5), FRAME_NS)
    assert field.valid[1:].all()
    assert (field.valid[0] == counts).all()


def test_a_grey_picture_is_followed_as_a_coloured_one():
    rng, tracker = np.random.default_rng(1), MarkerTracker()
    tracker.update(draw(REST, rng)[..., 1], 0)
    field = tracker.update(draw(REST + 0.5, rng)[..., 1], FRAME_NS)
    assert field.valid.all()
    assert field.displacement_px.mean((0, 1)) == pytest.approx((0.5, 0.5), abs=0.02)
