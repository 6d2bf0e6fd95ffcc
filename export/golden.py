"""Golden frames: the fixed inputs on which torch and ONNX Runtime must agree, and the hard ones that break graphs."""

import numpy as np
from numpy.typing import NDArray

from service.contract import FrameSpec

PITCH_PX, RADIUS_PX = 15, 2.5


def golden_frames(spec: FrameSpec, count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Dotted frames that shear and twist over time: uint8 [count, 2, H, W, 3]."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: spec.height_px, : spec.width_px].astype(np.float32)
    motion = rng.uniform(-1.0, 1.0, (2, 3))
    frames = np.empty((count, 2, *spec.shape), np.uint8)
    for index in range(count):
        for finger in range(2):
            shift_u, shift_v, twist = motion[finger] * index
            moved_u = u - shift_u + 0.01 * twist * (v - spec.height_px / 2)
            moved_v = v - shift_v - 0.01 * twist * (u - spec.width_px / 2)
            off_u = (moved_u + 2) % PITCH_PX - PITCH_PX / 2
            off_v = (moved_v - 2) % PITCH_PX - PITCH_PX / 2
            dark = np.clip(RADIUS_PX + 0.5 - np.hypot(off_u, off_v), 0, 1)[..., None]
            light = np.array([110.0, 170.0, 130.0]) + 30 * np.sin(u / 90 + finger)[..., None]
            frames[index, finger] = (light * (1 - 0.8 * dark) + rng.normal(0, 3, spec.shape)).clip(0, 255)
    return frames


def hard_frames(spec: FrameSpec, count: int) -> dict[str, NDArray[np.uint8]]:
    """Inputs no camera should send but some day one will; each uint8 [count, 2, H, W, 3]."""
    shape = (count, 2, *spec.shape)
    still = np.repeat(golden_frames(spec, 1), count, axis=0)
    spark = still.copy()
    spark[1:, 0, spec.height_px // 2, spec.width_px // 2] = 255
    flash = np.zeros(shape, np.uint8)
    flash[1::2] = 255
    return {
        "no difference": still,
        "single bright pixel": spark,
        "black": np.zeros(shape, np.uint8),
        "saturated": np.full(shape, 255, np.uint8),
        "black and white in turn": flash,
        "noise": np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8),
    }
