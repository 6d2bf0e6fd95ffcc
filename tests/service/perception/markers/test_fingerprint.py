"""A gel is known again by its print, whichever of its border rows are seen; another gel is not taken for it."""

import base64

import numpy as np
import pytest

from service.perception.markers.field import MarkerField
from service.perception.markers.fingerprint import (
    OTHER_GEL,
    TELLING_N,
    check_fingerprint,
    fingerprint,
    fingerprint_of,
    likeness,
    markers_n,
)
from tests.service.perception.synthetic import grid

ROWS, COLUMNS, PITCH_PX = 16, 18, 15.0


def print_of(points: np.ndarray, rows: slice = slice(None), columns: slice = slice(None)) -> str:
    """The fingerprint of the part of a gel that the tracker finds."""
    rest = points[rows, columns].astype(np.float32)
    shown = np.ones(rest.shape[:2], np.bool_)
    return fingerprint_of(MarkerField(rest, np.zeros_like(rest), shown, None, PITCH_PX, 0))


GEL, OTHER = (grid(ROWS, COLUMNS, PITCH_PX, seed=seed) for seed in (0, 1))
PARTS = {
    "whole": (slice(None), slice(None)),
    "a dark edge": (slice(0, -3), slice(None)),
    "a row and a column less": (slice(1, None), slice(0, -1)),
    "a row in, a row out": (slice(1, -1), slice(None)),
}


@pytest.mark.parametrize("part", PARTS)
def test_a_gel_is_known_again_by_a_part_of_its_print(part: str):
    alike = likeness(print_of(GEL), print_of(GEL, *PARTS[part]))
    assert alike is not None
    assert alike > 0.98


@pytest.mark.parametrize("part", PARTS)
def test_another_gel_is_not_taken_for_it_by_any_part_of_its_print(part: str):
    other = print_of(OTHER, *PARTS[part])
    assert markers_n(other) >= TELLING_N
    alike = likeness(print_of(GEL), other)
    assert alike is not None
    assert alike < OTHER_GEL


def test_a_picture_that_moved_by_a_row_shows_the_same_gel():
    """The grid is as large as before; all its markers have other neighbours at the border."""
    one, other = print_of(GEL, slice(0, -1), slice(1, None)), print_of(GEL, slice(1, None), slice(0, -1))
    alike = likeness(one, other)
    assert alike is not None
    assert alike > 0.98


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("more_n", [-1, 0, 1])
def test_two_prints_may_lack_two_rows_at_either_border_whichever_is_larger(axis: int, more_n: int):
    """The second one has ``more_n`` fewer, and begins further on than the first, or before it."""

    def alike(begins: int) -> float:
        parts = ((slice(3, 11), slice(None)), (slice(3 + begins, 11 + begins - more_n), slice(None)))
        one, other = (print_of(GEL, *(part if axis == 0 else part[::-1])) for part in parts)
        return likeness(one, other) or 0.0

    first, last = min(0, more_n) - 2, max(0, more_n) + 2
    assert min(alike(first), alike(last)) > 0.98
    assert max(alike(first - 1), alike(last + 1)) < OTHER_GEL


def test_a_fingerprint_holds_how_far_each_marker_is_off_the_grid_in_steps_of_five_thousandths_of_a_pitch():
    off = np.zeros((5, 6, 2))
    off[0, 1], off[2, 3], off[4, 5] = (0.1, -0.0524), (0.9, -0.9), (0.2, 0.2)
    visible = np.ones((5, 6), bool)
    visible[4, 5] = False
    coded = np.frombuffer(base64.b64decode(fingerprint(off, visible)), np.int8)
    grid = coded[2:].reshape(5, 6, 2)
    assert coded[:2].tolist() == [5, 6]
    assert (grid[0, 1].tolist(), grid[2, 3].tolist(), grid[4, 5].tolist()) == ([20, -10], [127, -127], [-128, -128])
    assert not np.delete(grid.reshape(30, 2), [1, 15, 29], 0).any()


def test_a_print_has_the_same_fingerprint_at_any_size():
    rest, shown = GEL.astype(np.float32), np.ones(GEL.shape[:2], np.bool_)
    larger = MarkerField(2 * rest, np.zeros_like(rest), shown, None, 2 * PITCH_PX, 0)
    values, doubled = (
        np.frombuffer(base64.b64decode(text), np.int8)[2:].astype(int)
        for text in (print_of(GEL), fingerprint_of(larger))
    )
    assert np.abs(values - doubled).max() <= 1, "a step of rounding"
    spread = float(values.std()) * 0.005
    assert spread == pytest.approx(0.3 / PITCH_PX, rel=0.15), "in pitches"


def test_a_fingerprint_is_that_of_the_places_now_wherever_the_markers_were_first_seen():
    moved = np.random.default_rng(2).normal(0, 2.0, GEL.shape).astype(np.float32)
    shown = np.ones(GEL.shape[:2], np.bool_)
    later = MarkerField(GEL.astype(np.float32) - moved, moved, shown, None, PITCH_PX, 0)
    assert likeness(fingerprint_of(later), print_of(GEL)) > 0.999


@pytest.mark.parametrize(("shared_n", "known"), [(23, False), (24, True)])
def test_two_prints_are_compared_by_24_shared_markers_or_more(shared_n: int, *, known: bool):
    few = fingerprint(np.random.default_rng(3).normal(0, 0.02, (4, 6, 2)), (np.arange(24) < shared_n).reshape(4, 6))
    assert (likeness(few, few) is not None) is known
    assert markers_n(few) == shared_n


def test_an_unknown_gel_or_one_without_irregularities_is_like_none():
    regular = fingerprint(np.zeros((6, 6, 2)), np.ones((6, 6), np.bool_))
    assert likeness(regular, regular) is None
    assert likeness("", print_of(GEL)) is None
    assert (markers_n(""), markers_n(regular)) == (0, 36)


@pytest.mark.parametrize("text", ["AQE=", "AQEA\nAA==", "AQEAAA", "grid"])
def test_a_text_that_is_no_fingerprint_is_refused(text: str):
    check_fingerprint("AQEAAA==")
    with pytest.raises(ValueError, match="no fingerprint of a gel"):
        check_fingerprint(text)
