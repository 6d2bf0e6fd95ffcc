"""Steps of depth do not depend on camera, speed or marker grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.contract.model_card import CONDITIONS, Lattice, Pressing, Span
from service.perception.pressing import DepthSteps, Legs, lattice_weights, on_lattice, onset_depth, step_weights

LATTICE = Lattice(rows=9, columns=9, pitch_mm=1.5)
SPEC = Pressing(lattice=LATTICE, step_mm=0.15, steps_n=8, trained={})


def field_at(pressed_mm: float) -> np.ndarray:
    """A shear and a turn that grow with depth."""
    u, v = np.moveaxis(LATTICE.points_mm, -1, 0)
    one = np.stack([0.3 + 0.01 * v, 0.5 - 0.01 * u, np.ones_like(u)], -1)
    one[..., :2] *= max(0.0, pressed_mm)
    return np.stack([one, one * np.array([-1, 1, 1])]).astype(np.float32)


def legs(*parts: tuple[int, float]) -> Legs:
    legs = Legs()
    for from_ns, speed_mm_s in parts:
        legs.add(from_ns, speed_mm_s)
    return legs


def steps(fps: float, speed_mm_s: float, phase: float = 0.3) -> list[np.ndarray]:
    """The steps of a descent that touches 2 mm down, seen at a rate."""
    spacing_mm = speed_mm_s / fps
    depths = np.arange(phase, 5.0 / spacing_mm) * spacing_mm
    stamps = [round(1e9 * depth / speed_mm_s) for depth in depths]
    fields = [field_at(depth - 2.0) for depth in depths]
    first = next(k for k, depth in enumerate(depths) if depth > 2.01)
    descent = DepthSteps(SPEC, legs((0, speed_mm_s)))
    descent.begin(stamps[: first + 1], fields[: first + 1], first)
    complete = descent.fresh()
    for stamp, field in zip(stamps[first + 1 :], fields[first + 1 :], strict=True):
        descent.add(stamp, field)
        complete += descent.fresh()
    return complete


@pytest.mark.parametrize(("fps", "speed_mm_s"), [(30, 10), (120, 3), (10, 3), (60, 25), (90, 40)])
def test_rate_and_speed_do_not_change_what_is_seen_at_a_depth(fps: float, speed_mm_s: float) -> None:
    complete = steps(fps, speed_mm_s)
    assert len(complete) == SPEC.steps_n
    for number, step in enumerate(complete):
        wanted = field_at((number + 0.5) * SPEC.step_mm)
        assert np.abs(step - wanted)[..., :2].max() < 0.02
        assert step[..., 2].all()


def test_the_onset_is_found_between_the_frames_that_frame_it() -> None:
    rng = np.random.default_rng(0)
    for begin_mm in (0.05, 0.2, 0.3):
        depths = np.arange(4) * 0.33
        fields = np.stack([field_at(depth - begin_mm)[..., :2] for depth in depths])
        noisy = (fields + rng.normal(0, 0.004, fields.shape)).astype(np.float32)
        assert onset_depth(depths, noisy, 1) == pytest.approx(begin_mm, abs=0.02)


def test_the_onset_lies_between_the_first_frame_that_moved_and_the_one_before_or_a_frame_earlier() -> None:
    depths, field = np.arange(4) * 0.3, np.ones((2, 9, 9, 2), np.float32)
    hardly_grown = np.stack([0 * field, 0 * field, field, 1.1 * field])
    assert onset_depth(depths, hardly_grown, 2) == 0.3, "the line would begin before the frame at rest"
    assert onset_depth(depths[2:], hardly_grown[2:], 0) == pytest.approx(0.3), "a frame earlier, as none is known"
    shrunk = np.stack([0 * field, -field, field, field])
    assert onset_depth(depths, shrunk, 1) == pytest.approx(0.3 - 1e-4), "never after the frame"


@given(
    st.lists(st.floats(0.01, 0.5), min_size=1, max_size=8),
    st.floats(-0.3, 0.6),
    st.floats(0.05, 1.0),
    st.integers(0, 99),
)
def test_a_step_is_the_mean_over_its_depth_of_what_frames_show_and_lies_between(
    gaps_mm: list[float], begin_mm: float, size_mm: float, seed: int
) -> None:
    """Before the first frame and after the last one, it is what that one shows."""
    depths = np.concatenate([[0.0], np.cumsum(gaps_mm)])
    shown, end_mm = np.random.default_rng(seed).normal(size=len(depths)), begin_mm + size_mm
    corners = np.unique([begin_mm, end_mm, *depths[(depths > begin_mm) & (depths < end_mm)]])
    between = np.interp(corners, depths, shown)
    mean = float((0.5 * (between[1:] + between[:-1]) * np.diff(corners)).sum()) / size_mm
    assert step_weights(depths, begin_mm, end_mm) @ shown == pytest.approx(mean, abs=1e-9)


@pytest.mark.parametrize("pitch_mm", [0.75 * 1.05, 0.8, 1.05, 1.3 * 1.05, 2.0])
def test_a_field_is_the_same_on_the_lattice_whatever_the_marker_pitch(pitch_mm: float) -> None:
    """The range that cards allow, whose networks have read a single pitch, rests on this."""
    side = np.arange(-10, 10.01, pitch_mm)
    rest = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2).astype(np.float32)
    moved = np.stack([0.1 + 0.01 * rest[:, 1], 0.2 - 0.01 * rest[:, 0]], -1)
    weights = lattice_weights(rest, LATTICE, pitch_mm)
    visible = np.random.default_rng(1).random(len(rest)) > 0.1
    read = on_lattice(moved, visible, weights).reshape(9, 9, 3)
    u, v = np.moveaxis(LATTICE.points_mm, -1, 0)
    assert read[..., 2].mean() > 0.9
    inside = read[..., 2] > 0
    assert np.abs(read[..., 0] - (0.1 + 0.01 * v))[inside].max() < 0.012
    assert np.abs(read[..., 1] - (0.2 - 0.01 * u))[inside].max() < 0.012


def test_a_point_without_markers_is_not_seen_and_shows_no_motion() -> None:
    rest = np.array([[-6.0, -6.0]], np.float32)
    read = on_lattice(np.array([[1.0, 1.0]], np.float32), np.array([True]), lattice_weights(rest, LATTICE, 1.05))
    assert not read[np.abs(LATTICE.points_mm.reshape(-1, 2) - rest).max(1) > 1.5].any()


def test_a_point_needs_a_quarter_of_the_markers_that_could_show_it() -> None:
    moved, weights = np.array([[1.0, 0.0], [4.0, 0.0]], np.float32), np.array([[0.2, 0.1]], np.float32)
    assert on_lattice(moved, np.array([True, True]), weights) == pytest.approx(np.array([[2.0, 0.0, 1.0]]))
    assert not on_lattice(moved, np.array([True, False]), weights).any()


STAMP_NS = st.integers(0, 5_000_000_000)


@given(st.lists(st.tuples(STAMP_NS, st.floats(1.0, 40.0)), min_size=1, max_size=4), st.lists(STAMP_NS, min_size=3))
def test_the_way_between_two_stamps_is_that_of_its_parts(parts: list[tuple[int, float]], stamps: list[int]) -> None:
    arm = legs(*sorted(parts))
    here, there, between = stamps[:3]
    whole = arm.travel_mm(here, there)
    assert whole == pytest.approx(arm.travel_mm(here, between) + arm.travel_mm(between, there), abs=1e-9)
    assert whole == pytest.approx(-arm.travel_mm(there, here))


def test_an_arm_has_gone_at_its_first_speed_before_and_nowhere_while_none_is_known() -> None:
    still = legs()
    assert (still.speed_mm_s(5), still.travel_mm(0, 1_000_000_000)) == (None, 0.0)
    still.pauses(1_000_000_000, 0.4)
    assert still.travel_mm(0, 2_000_000_000) == 0.0
    arm = legs((1_000_000_000, 10.0), (2_000_000_000, 5.0))
    assert arm.speed_mm_s(0) == 10.0
    assert arm.travel_mm(0, 1_000_000_000) == pytest.approx(10.0)


def test_an_arm_that_slows_or_pauses_goes_less_far() -> None:
    arm = legs((0, 10.0), (1_000_000_000, 5.0))
    assert (arm.speed_mm_s(999_999_999), arm.speed_mm_s(1_000_000_000)) == (10.0, 5.0)
    assert arm.travel_mm(500_000_000, 2_000_000_000) == pytest.approx(5.0 + 5.0)
    assert arm.paused_ns is None
    arm.pauses(3_000_000_000, 0.4)
    assert arm.paused_ns == 3_000_000_000
    assert arm.travel_mm(2_000_000_000, 4_000_000_000) == pytest.approx(0.6 * 5.0 + 5.0)


def test_a_speed_that_changes_in_the_press_changes_its_depth() -> None:
    """At 10 mm/s the object is touched, from 66 ms on the arm goes at 5 mm/s."""
    stamps = [0, 33_000_000, 66_000_000]
    arm = legs((0, 10.0), (66_000_000, 5.0))
    descent = DepthSteps(SPEC, arm)
    descent.begin(stamps, [field_at(0.0), field_at(0.0), field_at(0.2)], 2)
    descent.add(99_000_000, field_at(0.365))
    assert descent.pressed_at_mm(199_000_000) == pytest.approx(descent.pressed_mm + 0.5)


def test_a_stamp_that_does_not_advance_adds_nothing() -> None:
    descent = DepthSteps(SPEC, legs((0, 10.0)))
    stamps = [0, 33_000_000, 66_000_000]
    descent.begin(stamps, [field_at(0.0), field_at(0.0), field_at(0.2)], 2)
    assert descent.pressed_mm == 0.0
    assert descent.pressed_at_mm(66_000_000) is None, "two frames in motion show where it began"
    descent.add(99_000_000, field_at(0.53))
    before = descent.pressed_mm
    assert descent.pressed_at_mm(99_000_000) == pytest.approx(before)
    assert descent.pressed_at_mm(119_000_000) == pytest.approx(before + 0.2), "at 10 mm/s"
    descent.add(99_000_000, field_at(5.0))
    descent.add(50_000_000, field_at(5.0))
    assert descent.pressed_mm == before


def pressed(
    before: list[np.ndarray], hidden: dict[int, tuple[int, ...]] | None = None, arm: Legs | None = None
) -> list[np.ndarray]:
    """The steps of a press at 10 mm/s, seen at 100 Hz after the frames ``before``; points ``hidden`` in some frames."""
    rest_n, start = len(before), before[-1]
    fields = [
        *before,
        *(field_at(0.1 * k - 0.05) + start * np.array([1.0, 1.0, 0.0], np.float32) for k in range(1, 16)),
    ]
    for frame, point in (hidden or {}).items():
        fields[frame] = fields[frame].copy()
        fields[frame][point] = 0.0
    descent = DepthSteps(SPEC, arm or legs((0, 10.0)))
    stamps = [k * 10_000_000 for k in range(len(fields))]
    descent.begin(stamps[: rest_n + 1], fields[: rest_n + 1], rest_n)
    complete = []
    for stamp, field in zip(stamps[rest_n + 1 :], fields[rest_n + 1 :], strict=True):
        descent.add(stamp, field)
        complete += descent.fresh()
    return complete


STILL = field_at(0.0) + np.array([0.4, -0.3, 0.0], np.float32)


@pytest.mark.parametrize("rest_n", [1, 2, 5])
def test_motion_counts_from_the_mean_of_the_frames_at_rest(rest_n: int) -> None:
    """But for the last of several, which may have begun to move."""
    error = np.array([0.1, -0.2, 0.0], np.float32)
    noisy = [STILL + (-1) ** k * error for k in range((rest_n - 1) // 2 * 2)]
    complete = pressed([*noisy, *[STILL] * (rest_n - len(noisy))])
    assert len(complete) == SPEC.steps_n
    for number, step in enumerate(complete):
        assert step == pytest.approx(field_at((number + 0.5) * SPEC.step_mm), abs=0.02)


def test_an_arm_that_stood_before_it_touched_presses_as_one_that_did_not() -> None:
    waited = pressed([STILL] * 4, arm=legs((0, 0.0), (30_000_000, 10.0)))
    assert np.stack(waited) == pytest.approx(np.stack(pressed([STILL] * 4)))


def test_a_point_hidden_in_any_frame_of_a_step_or_of_the_rest_is_not_seen_in_it() -> None:
    at_rest, later = (0, 2, 3), (1, 4, 5)
    complete = np.stack(pressed([STILL] * 4, {1: at_rest, 11: later}))  # the latter shows 0.75 mm
    visible = np.ones(complete.shape[:-1])
    visible[(slice(None), *at_rest)] = 0.0
    visible[(slice(4, 6), *later)] = 0.0
    assert np.array_equal(complete[..., 2], visible)
    assert not complete[visible == 0].any()


def test_what_lies_outside_training_is_named() -> None:
    spec = Pressing(lattice=LATTICE, step_mm=0.15, steps_n=8, trained={"speed_mm_s": Span(low=3, high=40)})
    assert spec.outside({"speed_mm_s": 10.0, "grip_n": None}) == ""
    assert "speed_mm_s is 50" in spec.outside({"speed_mm_s": 50.0})
    assert "speed_mm_s is 41" in spec.outside({"speed_mm_s": 41.0})
    assert "speed_mm_s is nan" in spec.outside({"speed_mm_s": float("nan")})
    assert CONDITIONS[4] == "speed_mm_s"
    with pytest.raises(ValueError, match="none of"):
        Pressing(lattice=LATTICE, step_mm=0.15, steps_n=8, trained={"spede": Span(low=3, high=40)})
