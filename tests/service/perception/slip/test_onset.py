"""The onset is the first frame in which the held object has moved on, whatever the gel showed before."""

from dataclasses import replace

import numpy as np
import pytest

from service.perception.slip.onset import OnsetDetector
from tests.service.perception.synthetic import FRAME_NS, patch_fields, rigid


def fields(first: int, step_px: float, noise_px: float, seed: int = 0):
    """A patch at rest that moves on by that much a frame from frame ``first`` on; the grip has moved all by 9 px."""
    moving = patch_fields(
        lambda k, rest: rigid((0.0, step_px))(max(0, k - first + 1), rest), frames=30, noise_px=noise_px, seed=seed
    )[0]
    return [replace(one, displacement_px=one.displacement_px + np.float32(9.0)) for one in moving]


def onset(some):
    detector = OnsetDetector()
    detector.rearm(some[0])
    stamps = [detector.update(one) for one in some[1:]]
    assert len({stamp for stamp in stamps if stamp is not None}) <= 1, "once known it stays"
    return stamps[-1]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise_px", [0.02, 0.1])
def test_the_onset_is_the_frame_in_which_the_object_moves_on(noise_px, seed):
    assert onset(fields(20, 0.8, noise_px, seed)) == 20 * FRAME_NS
    assert onset(fields(99, 0.8, noise_px, seed)) is None


def test_frames_without_new_evidence_change_nothing():
    some = fields(20, 0.8, 0.02)
    some[20] = replace(some[20], status="duplicate")
    assert onset(some) == 21 * FRAME_NS
    detector = OnsetDetector()
    detector.rearm(replace(some[0], status="lost"))
    assert [detector.update(one) for one in some] == [None] * len(some), "nothing to compare with"


@pytest.mark.parametrize(("rest_n", "is_onset"), [(2, False), (3, True)])
def test_three_frames_at_rest_show_how_little_counts(rest_n, is_onset):
    """A motion between the smallest that counts and one and a half times that, in a gel without jitter."""
    still = fields(99, 0.0, 0.0)
    moved = replace(still[rest_n + 1], displacement_px=still[0].displacement_px + np.float32([0.0, 1.25 * 0.012 * 15]))
    assert (onset([*still[: rest_n + 1], moved]) is not None) is is_onset
