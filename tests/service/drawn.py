"""Imprints as a finger sees them: the simulator's renderer over hand-made gel motions."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from service.contract import Finger, FramePair, FrameSpec, TactileFrame
from service.perception.finger import TactileFinger
from service.perception.rectification import Calibration
from simulation.optics.renderer import Appearance, Renderer

PERIOD_NS = 33_333_333


@lru_cache
def renderer(finger: Finger) -> Renderer:
    return Renderer(Appearance(finger=finger, noise_sigma_grey=2.0))


def calibration() -> Calibration:
    return Calibration(*(renderer(finger).calibration for finger in ("left", "right")))


def watch(finger: Finger = "left") -> TactileFinger:
    """One finger of a live session over these imprints."""
    return TactileFinger(finger, FrameSpec(height_px=320, width_px=327), renderer(finger).calibration)


def gel(shift_mm: float, slip_mm: float = 0.0) -> NDArray[np.float32]:
    """A patch pressed in the middle, so that it bulges, carried up by ``shift_mm``; its rim lags by ``slip_mm``."""
    rows, cols = np.mgrid[0:20, 0:21]
    distance = np.hypot((rows - 9.5) / 8.0, (cols - 10.0) / 8.5)
    inside = np.clip(1.3 - distance, 0, 1) / 1.0
    state = np.zeros((20, 21, 3), np.float32)
    state[..., 0] = 0.12 * inside * (cols - 10.0) / 8.5
    state[..., 1] = 0.12 * inside * (rows - 9.5) / 8.0 - np.clip(inside * 1.6, 0, 1) * shift_mm
    rim = (distance > 0.55) & (distance < 0.85)
    state[..., 1] += np.where(rim, slip_mm, 0)
    state[..., 2] = 0.05 * np.clip(1 - distance, 0, 1)
    return state


@lru_cache(maxsize=400)
def raw(finger: Finger, index: int, onset: int, slip_at: int) -> NDArray[np.uint8]:
    """Frame ``index`` of a probe whose object begins to move at ``onset`` and slips from ``slip_at`` on."""
    shift = 0.06 * max(0, index - onset + 1)
    slip = 0.15 * max(0, index - slip_at + 1)
    still = min(index, slip_at + 2)
    if index > still:
        shift, slip = 0.06 * max(0, still - onset + 1), 0.45
    return renderer(finger).raw(gel(shift, slip), index * 7 + (finger == "right"))


@lru_cache
def untouched(finger: Finger) -> NDArray[np.uint8]:
    """A frame of an untouched finger."""
    return renderer(finger).raw(np.zeros((20, 21, 3), np.float32), 1)


def pair(index: int, onset: int = 10, slip_at: int = 16, start_ns: int = 0, period_ns: int = PERIOD_NS) -> FramePair:
    """A pair of raw frames at its time."""
    stamp = start_ns + index * period_ns
    left, right = (TactileFrame(f, index, stamp, raw(f, index, onset, slip_at)) for f in ("left", "right"))
    return FramePair(left, right)
