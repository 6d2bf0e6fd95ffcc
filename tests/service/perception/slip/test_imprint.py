"""An imprint moving over the gel is distinguished from one carried along by it, and stops the arm."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract import FrameSpec, TactileFrame
from service.perception.finger import TactileFinger
from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.imprint import ImprintChange, ImprintWatch, _all_but, _Grid
from service.perception.slip.slide import SlideWitness
from service.session.fingers import Fingers
from tests.service.perception.synthetic import draw, grid

PERIOD_NS = 125_000_000
REST = grid(7, 9, 32.0, 320, 240, jitter=0.2)
STILL = [0.0] * 8


def picture(rng, imprint_px, gel_px, height=1.0, noise=1.0):
    """A gel carried sideways by ``gel_px``, and a ridge on it, displaced by ``imprint_px``."""
    image = draw(REST + np.array([gel_px, 0.0]), rng, 320, 240, diameter=10.0, noise=noise).astype(np.float64)
    u = np.arange(320) - 150.0 - imprint_px
    ridge = 35 * height * np.exp(-np.square(u / 9.0)) * u / 9.0
    image[70:170] += ridge[:, None] * [1.0, 0.2, -1.0]
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def scores(walk_px, gel_px, height=1.0, noise=1.0):
    rng, witness = np.random.default_rng(3), SlideWitness()
    fingers = [(MarkerTracker(), ImprintWatch()) for _ in range(2)]
    for k, (imprint, gel) in enumerate(zip(walk_px, gel_px, strict=True)):
        images = [picture(rng, imprint, gel, height, noise) for _ in fingers]
        yield witness.update(
            [
                watch.update(image, tracker.update(image, k * PERIOD_NS))
                for image, (tracker, watch) in zip(images, fingers, strict=True)
            ]
        )


def test_an_imprint_that_walks_over_the_gel_slides_and_one_that_the_gel_carries_does_not():
    way = [*STILL, 4.0, 8.0, 12.0, 16.0]
    slid, carried = list(scores(way, [0.0] * 12)), list(scores(way, way))
    assert slid[0] is None
    assert max(slid[2:8]) < 0
    assert max(slid[8:]) >= 0
    assert max(carried[2:]) < 0


def test_an_imprint_that_creeps_over_both_gels_slides_once_it_has_gone_far():
    creep = [*STILL, *np.arange(1.0, 36.0)]
    crept = list(scores(creep, [0.0] * len(creep)))
    assert max(crept[2:24]) < 0
    assert min(crept[36:]) >= 0


def test_the_walk_of_an_imprint_is_measured_and_a_stronger_press_is_none():
    rng, tracker, watch = np.random.default_rng(3), MarkerTracker(), ImprintWatch()
    walks = []
    for k, (way, height) in enumerate([(0.0, 0.8), (0.0, 1.0), (3.0, 1.0), (3.0, 1.2)]):
        change = watch.update(image := picture(rng, way, 0.0, height), tracker.update(image, k * PERIOD_NS))
        walks.append(change.walked_pitch if change else (0.0, 0.0))
    assert walks[1:] == [pytest.approx(way, abs=0.03) for way in ((0.0, 0.0), (3.0 / 32.0, 0.0), (0.0, 0.0))]


def test_where_one_imprint_stays_the_object_does_not_slide():
    def score(*walks):
        witness = SlideWitness()
        return [witness.update([ImprintChange(1.0, 1.0, 1.0, 6.0, 0.03, walk) for walk in walks]) for _ in range(3)][-1]

    assert score((0.1, 0.0), (0.05, 0.0)) >= 0
    assert score((0.1, 0.0), (0.0, 0.0)) < 0


@pytest.mark.parametrize("height", [0.0, 1.0])
def test_noise_of_the_camera_is_no_slide(height):
    assert max(list(scores([0.0] * 16, [0.0] * 16, height, noise=6.0))[2:]) < 0


def test_the_same_slide_in_a_strong_grip_is_less_sure_to_end_in_a_loss():
    faint, light, strong = (
        SlideWitness().update([ImprintChange(0.8, 1.0, 0.2, relief, 0.03, (0.03, 0.0))] * 2)
        for relief in (1.0, 6.0, 12.0)
    )
    assert strong < light
    assert faint - light < 0.5  # no sensor showed an imprint as faint; that it is hardly held is not known


def test_black_beyond_the_raw_frame_is_no_relief():
    """Where a rectified frame reaches beyond the raw one, its edge is no imprint of a strong grip."""
    rng, reliefs = np.random.default_rng(3), []
    images = [picture(rng, 0.0, 0.0) for _ in range(2)]
    for columns in (0, 45):
        tracker, watch = MarkerTracker(), ImprintWatch()
        for k, image in enumerate(images):
            field, cut = tracker.update(image, k * PERIOD_NS), image.copy()
            cut[:, :columns] = 0
            change = watch.update(cut, field)
        assert change is not None
        reliefs.append(change.relief)
    assert reliefs[1] == pytest.approx(reliefs[0], rel=0.15)


def test_a_rim_that_slides_is_seen_beside_an_imprint_that_stays():
    rng, tracker, watch = np.random.default_rng(3), MarkerTracker(), ImprintWatch()
    for k, way in enumerate([0.0, 0.0, 6.0]):
        image = picture(rng, 0.0, 0.0, height=1.5)
        image[70:95] = picture(rng, way, 0.0)[70:95]
        change = watch.update(image, tracker.update(image, k * PERIOD_NS))
    assert change is not None
    assert change.changed > 0.06


def test_one_finger_alone_tells_no_slide():
    assert SlideWitness().update([ImprintChange(1.0, 1.0, 1.0, 3.0, 0.01, (0.1, 0.0))]) is None


def test_a_slide_before_the_imprint_was_out_of_sight_counts_no_more():
    """As between two attempts: a change counts from its second frame on, and the first one was of another motion."""

    def one_change():
        return [ImprintChange(1.0, 1.0, 0.2, 3.0, 0.03, (0.03, 0.0)) for _ in range(2)]

    witness, fresh = SlideWitness(), SlideWitness()
    assert [witness.update(one_change()) for _ in range(3)][-1] >= 0
    assert witness.update([None, *one_change()[1:]]) is None
    assert witness.update(one_change()) == fresh.update(one_change()) < 0


def test_frames_close_in_time_are_looked_at_once():
    rng, tracker, watch = np.random.default_rng(3), MarkerTracker(), ImprintWatch()
    changes = []
    for k in range(12):
        image = picture(rng, 0.0, 0.0)
        changes.append(watch.update(image, tracker.update(image, k * PERIOD_NS // 5)))
    assert len({id(one) for one in changes if one is not None}) == 2


@pytest.mark.parametrize("asked", [True, False])
def test_a_sliding_imprint_stops_the_arm_where_that_is_asked_for(asked):
    spec, rng = FrameSpec(height_px=240, width_px=320), np.random.default_rng(3)
    fingers = Fingers(*(TactileFinger(side, spec, imprint=asked) for side in ("left", "right")))
    for side in ("left", "right"):
        fingers.watch(side).rearm()
    slips = []
    for k, way in enumerate([*STILL, 4.0, 8.0, 12.0, 16.0]):
        for side in ("left", "right"):
            frame = TactileFrame(side, k, k * PERIOD_NS, picture(rng, way, 0.0))
            slips.append(fingers.observe(frame).slip)
    assert not any(slip.stop for slip in slips[:16])
    assert any(slip.stop and "imprint" in slip.reason for slip in itertools.islice(slips, 16, None)) == asked


@pytest.mark.parametrize(("after", "sign"), [(0.4, 1.0), (2.0, -1.0)])
def test_relief_that_goes_counts_as_lost_and_relief_that_comes_against_it(after, sign):
    rng, tracker, watch = np.random.default_rng(3), MarkerTracker(), ImprintWatch()
    for k, height in enumerate([1.0, 1.0, after]):
        change = watch.update(image := picture(rng, 0.0, 0.0, height), tracker.update(image, k * PERIOD_NS))
    assert change is not None
    assert sign * change.let_go > 0.2


@pytest.mark.parametrize(("pause_ns", "compared"), [(590_000_000, True), (610_000_000, False)])
def test_after_six_tenths_of_a_second_an_imprint_is_compared_with_none_before(pause_ns, compared):
    rng, tracker, watch, stamp_ns = np.random.default_rng(3), MarkerTracker(), ImprintWatch(), 0
    for pause in (0, PERIOD_NS, pause_ns):
        stamp_ns += pause
        change = watch.update(image := picture(rng, 0.0, 0.0), tracker.update(image, stamp_ns))
    assert (change is not None) is compared


@given(st.integers(1, 200), st.sampled_from([0.05, 0.1]))
def test_all_but_a_share_of_the_values_lie_at_or_below_their_bound(values_n, share):
    values = np.random.default_rng(values_n).permutation(values_n).astype(np.float32)
    assert _all_but(share, values) == int((1 - share) * (values_n - 1))


def waves(grid, right, down):
    """An imprint of long waves, moved by so many samples; [h, w, channels] as the grid samples it."""
    shape = grid._unmarked.shape
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    x, y = x - right, y - down
    channels = [np.sin(0.21 * x + 0.13 * y), np.sin(0.11 * x - 0.19 * y + 1.0), np.cos(0.16 * x + 0.05 * y)]
    return (30.0 * np.stack(channels, -1) * grid._unmarked).astype(np.float32)


@pytest.mark.parametrize(("shape", "pitch_samples"), [((7, 9), 8), ((14, 12), 4)])
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.8, 1.25))
def test_an_imprint_walks_right_and_down_by_its_shift_whatever_its_pressure(shape, pitch_samples, right, down, times):
    grid = _Grid(shape, 20.0, 3)
    walked = grid.walk(waves(grid, 0.0, 0.0), times * waves(grid, right, down))
    assert np.array(walked) * pitch_samples == pytest.approx((right, down), abs=0.05)


def test_the_power_of_an_imprint_is_its_mean_square_where_no_marker_hides_it():
    grid = _Grid((7, 9), 20.0, 3)
    even = np.asarray(grid._unmarked * np.array([3.0, 0.0, 6.0], np.float32), np.float32)
    assert grid.power(even) == pytest.approx(np.full(even.shape[:2], 15.0), rel=1e-4)
    left = even.copy()
    left[:, 32:] = 0.0
    assert grid.power(left)[:, :23] == pytest.approx(15.0, rel=1e-4)
    assert not grid.power(left)[:, 42:].any(), "nothing is seen further than half a pitch and a marker"
