import numpy as np
import pytest

from service.perception.markers.tracker import MarkerTracker
from service.perception.slip.detector import SlipDetector
from tests.service.perception.synthetic import FRAME_NS, draw, grid, stretched, twist

SENSORS = [
    (7, 9, 320, 240, 34.0, 14.0),
    (11, 16, 384, 278, 23.5, 9.0),
    (20, 21, 327, 320, 15.0, 5.0),
    (14, 18, 640, 480, 33.0, 11.0),
    (20, 21, 640, 480, 22.0, 8.0),
]


def follow(tracker, images, start=0):
    return [tracker.update(image, (start + k) * FRAME_NS) for k, image in enumerate(images)]


def identity(field, truth, width=327, height=320, margin=6.0):
    """Share of the visible markers that are tracked as themselves, within a quarter pitch."""
    error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
    inside = (truth > margin).all(-1) & (truth[..., 0] < width - margin) & (truth[..., 1] < height - margin)
    return float((field.valid & (error < 0.25 * field.pitch_px))[inside].mean())


@pytest.mark.parametrize(("noise", "limit_px"), [(2.0, 0.04), (6.0, 0.08)])
def test_displacement_is_found_to_a_few_hundredths_of_a_pixel(noise, limit_px):
    rng = np.random.default_rng(1)
    rest = grid()
    errors = []
    tracker = MarkerTracker()
    tracker.update(draw(rest, rng, noise=noise), 0)
    first = rest
    for k in range(1, 6):
        moved = twist(rest, 0.8 * k, shift=(0.37 * k, -0.61 * k))
        field = tracker.update(draw(moved, rng, noise=noise), k * FRAME_NS)
        error = (field.displacement_px - (moved - first))[field.valid]
        errors.append(error)
    rms = float(np.sqrt(np.square(np.concatenate(errors)).mean()))  # per axis
    assert rms < limit_px


def test_a_marker_torn_long_is_no_evidence():
    rng = np.random.default_rng(6)
    rest = grid()
    tracker = MarkerTracker()
    follow(tracker, [draw(rest, rng)])
    image = draw(rest, rng)
    u, v = np.rint(rest[10, 10]).astype(int)
    image[v - 6 : v + 6, u - 1 : u + 2] = image[v, u]  # a bar more than twice as long as the marker
    field = tracker.update(image, FRAME_NS)
    assert not field.valid[10, 10]
    assert field.valid.sum() == field.valid.size - 1


def shifted(points, u, v):
    return points + np.array([u, v])


@pytest.mark.parametrize(
    "jump",
    [
        lambda p: shifted(p, 13.5, 0),
        lambda p: shifted(p, -13.5, 0),
        lambda p: shifted(p, 0, 13.5),
        lambda p: shifted(p, 9.5, -9.5),
        lambda p: shifted(p, 7.5, 7.5),  # no spot is near any marker's last place
        lambda p: p + np.array([13.5, 0]) * np.exp(-np.square(p - 160).sum(-1) / 2 / 50**2)[..., None],
        lambda p: shifted(p, 45, 0),  # exactly three pitches: only the border tells
        lambda p: shifted(p, 0, -45),
        lambda p: shifted(p, 30, 45),
        lambda p: twist(p, 20),
        lambda p: twist(p, 35),
    ],
)
def test_markers_keep_their_identity_over_a_jump(jump):
    rng = np.random.default_rng(2)
    rest = grid()
    tracker = MarkerTracker()
    follow(tracker, [draw(rest, rng, noise=6.0) for _ in range(3)])
    truth = jump(rest)
    field = tracker.update(draw(truth, rng, noise=6.0), 3 * FRAME_NS)
    assert field.status == "tracking"
    assert identity(field, truth) >= 0.99


def mistaken(field, truth):
    """Share of the measured markers that are half a pitch or more from where they are."""
    error = np.linalg.norm(field.rest_px + field.displacement_px - truth, axis=-1)
    return float((error > 0.5 * field.pitch_px)[field.valid].mean())


@pytest.mark.parametrize("hidden", [0.3, 0.4, 0.5])
@pytest.mark.parametrize("side", [0, 1])
def test_markers_hidden_at_a_border_are_no_jump_of_a_pitch(hidden, side):
    rng = np.random.default_rng(7)
    rest = grid()
    tracker = MarkerTracker()
    follow(tracker, [draw(rest, rng) for _ in range(3)])
    covered = [draw(rest, rng) for _ in range(3)]
    for image in covered:
        columns = round(hidden * image.shape[1])
        image[:, slice(None, columns) if side == 0 else slice(-columns, None)] = 90
    for k, image in enumerate([*covered, draw(rest, rng)], 3):
        field = tracker.update(image, k * FRAME_NS)
        assert mistaken(field, rest) <= 0.01
        assert field.valid.mean() > 0.95 - hidden
    assert field.valid.mean() > 0.99


def test_a_grip_that_stretches_the_middle_of_the_gel_carries_each_marker_along():
    rng = np.random.default_rng(8)
    rest = grid()
    tracker = MarkerTracker()
    follow(tracker, [draw(rest, rng)])
    truth = stretched(rest, 26.0)
    assert np.abs(truth - rest).max() > 0.9 * 15.0, "by nearly a pitch"
    field = tracker.update(draw(truth, rng), FRAME_NS)
    assert field.valid.mean() > 0.95
    assert mistaken(field, truth) <= 0.01


@pytest.mark.parametrize("step_deg", [5.0, -5.0])
def test_a_twist_of_sixty_degrees_is_followed_and_is_not_slip(step_deg):
    rng = np.random.default_rng(3)
    rest = grid()
    tracker, slip = MarkerTracker(), SlipDetector()
    for k in range(round(60 / abs(step_deg)) + 1):
        truth = twist(rest, step_deg * k)
        field = tracker.update(draw(truth, rng), k * FRAME_NS)
        assert identity(field, truth) >= 0.98
        state = slip.update(field) if k else slip.rearm(field)
        assert not state.slip, f"{step_deg * k} deg: {state.reason}"


@pytest.mark.parametrize(("rows", "cols", "width", "height", "pitch", "diameter"), SENSORS)
def test_the_grid_is_found_by_itself(rows, cols, width, height, pitch, diameter):
    rng = np.random.default_rng(4)
    points = grid(rows, cols, pitch, width, height)
    tracker = MarkerTracker()
    field = tracker.update(draw(points, rng, width, height, diameter), 0)
    assert field.valid.shape == (rows, cols)
    assert field.pitch_px == pytest.approx(pitch, rel=0.02)
    assert identity(field, points, width, height) == 1.0


def slid(points, k, pitch, hold_pitch):
    """A patch of sticking nodes carried down by 0.1 pitch a frame; its outer third lets go at ``hold_pitch``."""
    middle, half = points.mean((0, 1)), 0.42 * np.ptp(points, axis=(0, 1))
    rho = np.linalg.norm((points - middle) / half, axis=-1)
    way = 0.1 * pitch * k
    limit = np.where(rho < 0.65, np.inf, hold_pitch * pitch)
    carried = np.where(rho < 1, np.minimum(way, limit), 0.5 * way * np.exp(-3 * (rho - 1)))
    return points + np.stack([np.zeros_like(carried), carried], -1)


@pytest.mark.parametrize(("rows", "cols", "width", "height", "pitch", "diameter"), SENSORS[:4])
def test_slip_is_seen_at_every_size_and_grid_and_sticking_is_not_slip(rows, cols, width, height, pitch, diameter):
    rng = np.random.default_rng(14)
    points = grid(rows, cols, pitch, width, height)
    for hold_pitch, expected in ((0.6, True), (np.inf, False)):
        tracker, slip, first = MarkerTracker(), SlipDetector(), None
        for k in range(12):
            image = draw(slid(points, k, pitch, hold_pitch), rng, width, height, diameter)
            field = tracker.update(image, k * FRAME_NS)
            state = slip.update(field) if k else slip.rearm(field)
            first = k if state.slip and first is None else first
        assert (first is not None) == expected
        assert not expected or 6 <= first <= 9, f"let go after frame 6, seen at {first}"


def test_an_exposure_jump_moves_no_marker():
    rng = np.random.default_rng(5)
    rest = grid()
    tracker = MarkerTracker()
    fields = follow(tracker, [draw(rest, rng, light=light) for light in (140, 140, 70, 210, 50)])
    for field in fields[1:]:
        assert identity(field, rest) >= 0.99
        assert np.abs(field.displacement_px[field.valid]).max() < 0.6


def test_repeated_and_late_frames_are_no_new_evidence():
    rng = np.random.default_rng(6)
    image = draw(grid(), rng)
    tracker = MarkerTracker()
    tracker.update(image, 10)
    assert tracker.update(image, 20).status == "duplicate"
    assert tracker.update(draw(grid(), rng), 5).status == "duplicate"
    assert tracker.update(draw(grid(), rng), 30).status == "tracking"


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_blank_frame_is_lost_not_an_error(level):
    rng = np.random.default_rng(8)
    rest = grid()
    blank = np.full((320, 327, 3), level, np.uint8)
    tracker = MarkerTracker()
    assert tracker.update(blank, 0).status == "no_grid"
    assert tracker.update(draw(rest, rng), 1).status == "tracking"
    lost = tracker.update(blank, 2)
    assert lost.status == "lost"
    assert np.isfinite(lost.displacement_px).all()
    assert not lost.valid.any()
    assert tracker.update(None, 3).status == "lost"
    assert identity(tracker.update(draw(rest, rng), 4), rest) >= 0.99


def test_a_picture_that_turns_into_unchanging_black_is_lost_for_good_and_so_is_its_finger():
    rng, rest = np.random.default_rng(8), grid()
    black = np.zeros((320, 327, 3), np.uint8)
    tracker, slip = MarkerTracker(), SlipDetector()
    slip.rearm(tracker.update(draw(rest, rng), 0))
    fields = [tracker.update(black, k * FRAME_NS) for k in range(1, 31)]
    assert {field.status for field in fields} == {"lost"}
    assert not any(field.valid.any() for field in fields)
    assert {field.reason for field in fields} == {"0 markers in sight"}
    states = [slip.update(field).state for field in fields]
    assert (states[0], states[-1]) == ("unknown", "lost")
    assert tracker.update(draw(rest, rng), 31 * FRAME_NS).status == "tracking"


def test_a_repeated_frame_after_a_missing_one_is_the_one_before_that():
    image, tracker = draw(grid(), np.random.default_rng(8)), MarkerTracker()
    fields = [tracker.update(one, k) for k, one in enumerate((image, None, image))]
    assert [field.status for field in fields] == ["tracking", "lost", "duplicate"]


def test_a_frame_of_another_size_or_type_is_refused():
    tracker = MarkerTracker()
    tracker.update(draw(grid(), np.random.default_rng(9)), 0)
    with pytest.raises(ValueError, match=r"frame is \[100, 100, 3\], the tracker began with \[320, 327, 3\]"):
        tracker.update(np.zeros((100, 100, 3), np.uint8), 1)
    for image in (np.zeros((320, 327, 3), np.float32), np.zeros((320, 327, 4), np.uint8), np.zeros(9, np.uint8)):
        with pytest.raises(ValueError, match="expected uint8"):
            MarkerTracker().update(image, 1)


def borderless(way, towards=(1.0, 0.0)):
    """Pictures of a grid larger than they are, shifted by these shares of a pitch."""
    rng, wide = np.random.default_rng(4), grid(24, 25, jitter=0.0)
    return [draw(wide + 15.0 * shift * np.array(towards), rng) for shift in way]


@pytest.mark.parametrize("towards", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
def test_a_jump_that_may_be_a_whole_pitch_is_said_to_be_ambiguous_and_forgotten(towards):
    """A grid that fills the picture has no border: one step more or less looks the same."""
    way = [0, 0.3, 0.55, 0.9, 0.3, 0.0, 0.0]
    fields = follow(MarkerTracker(), borderless(way, towards))
    unsure = [field for field in fields if field.status == "ambiguous"]
    assert unsure
    assert not any(field.usable or field.valid.any() for field in unsure)
    for field, shift in zip(fields[5:], way[5:], strict=True):
        assert field.usable
        moved = np.median(field.displacement_px[field.valid], 0) / 15
        assert abs(moved - shift * np.array(towards)).max() < 0.1, "the grid has not slid by a step"


def torn_once(up_px):
    """One picture of another grasp tears the grid, whose upper row the picture's border cuts."""
    rng = np.random.default_rng(0)
    rest = grid(6, 7, pitch=22.0, width=160, height=120, jitter=0.2, seed=1) - [0, up_px]
    pressed = rest.copy()
    for marker, carried, wide in (((2, 3), (-10.0, 15.0), 40.0), ((5, 5), (-12.0, -17.0), 29.0)):
        near = np.exp(-np.square(rest - rest[marker]).sum(-1) / 2 / wide**2)
        pressed += np.array(carried) * near[..., None]
    hidden = np.zeros(rest.shape[:2], bool)
    hidden[[0, 0, 1, 2, 2, 2, 3, 4, 4, 4, 5], [3, 6, 0, 1, 3, 4, 5, 0, 1, 2, 1]] = True
    way = [rest, rest, rest, pressed[~hidden], (rest + pressed) / 2, rest, rest, rest]
    return [draw(points, rng, 160, 120, 10.0) for points in way]


@pytest.mark.parametrize("up_px", [1.0, 3.0])
def test_a_grid_followed_a_step_off_after_a_jump_is_found_again_at_rest(up_px):
    fields = follow(MarkerTracker(), torn_once(up_px))
    assert fields[3].status == "ambiguous", "otherwise this tests nothing"
    assert fields[5].status == "ambiguous"
    assert all(field.status == "tracking" for field in fields[6:])
    assert np.abs(fields[-1].displacement_px[fields[-1].valid]).max() < 0.1 * 22
