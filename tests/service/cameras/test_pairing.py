"""Frames of two free-running cameras become pairs of one instant."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from service.cameras.capture import WAITING_N, Pairer
from service.contract import Finger, FramePair, TactileFrame

BLACK = np.zeros((4, 4, 3), np.uint8)


def frame(finger: Finger, seq: int, stamp_ms: float) -> TactileFrame:
    return TactileFrame(finger, seq, int(stamp_ms * 1e6), BLACK)


def pairs_of(phase_ms: float, jitter_ms: list[float]) -> list[FramePair]:
    """Pairs from 40 frames per finger at 30 fps, the right ones late by the phase, each moved by its jitter."""
    pairer = Pairer()
    frames = [frame("left", i, 100 + 33.3 * i + jitter_ms[i]) for i in range(40)]
    frames += [frame("right", i, 100 + 33.3 * i + phase_ms + jitter_ms[40 + i]) for i in range(40)]
    pairs = [p for f in sorted(frames, key=lambda f: f.captured_ns) if (p := pairer.add(f))]
    for finger in ("left", "right"):
        used = [getattr(p, finger).seq for p in pairs]
        assert len(used) == len(set(used))
    assert all(abs(p.left.captured_ns - p.right.captured_ns) <= 0.7 * 33.3e6 for p in pairs)
    return pairs


@given(phase_ms=st.floats(0, 33), jitter_ms=st.lists(st.floats(-0.5, 0.5), min_size=80, max_size=80))
def test_frames_of_steady_cameras_pair_whatever_the_phase(phase_ms: float, jitter_ms: list[float]) -> None:
    assert len(pairs_of(phase_ms, jitter_ms)) >= 39


def test_chance_jitter_of_a_tenth_of_a_period_leaves_nine_pairs_of_ten() -> None:
    rng = np.random.default_rng(0)
    kept = [len(pairs_of(rng.uniform(0, 33), rng.uniform(-4, 4, 80).tolist())) for _ in range(400)]
    assert np.percentile(kept, 2) >= 36


@given(phase_ms=st.floats(0, 33), jitter_ms=st.lists(st.floats(-4, 4), min_size=80, max_size=80))
def test_the_worst_jitter_costs_at_most_half_of_the_pairs(phase_ms: float, jitter_ms: list[float]) -> None:
    assert len(pairs_of(phase_ms, jitter_ms)) >= 20


def test_a_silent_finger_pairs_with_nothing() -> None:
    pairer = Pairer()
    assert all(pairer.add(frame("left", i, 33.3 * i)) is None for i in range(20))
    assert pairer.dropped_n == 20 - WAITING_N


@given(arrives_ms=st.floats(0, 80), phase_ms=st.floats(-5.5, 5.5))
def test_a_camera_whose_pictures_arrive_late_pairs_with_those_taken_at_the_same_time(
    arrives_ms: float, phase_ms: float
) -> None:
    """As one behind a slower link: at 90 frames a second its pictures may come several periods after the other's."""
    pairer, period_ms = Pairer(), 1000 / 90
    frames = [(100 + period_ms * i, frame("left", i, 100 + period_ms * i)) for i in range(60)]
    right = [frame("right", i, 100 + period_ms * i + phase_ms) for i in range(60)]
    frames += [(one.captured_ns / 1e6 + arrives_ms, one) for one in right]
    pairs = [pair for _, one in sorted(frames, key=lambda item: item[0]) if (pair := pairer.add(one))]
    assert len(pairs) >= 58
    assert all(abs(pair.left.captured_ns - pair.right.captured_ns) <= 0.61 * period_ms * 1e6 for pair in pairs)
    assert pairer.dropped_n <= WAITING_N
