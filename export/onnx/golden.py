"""Golden frames: the fixed inputs on which torch and ONNX Runtime must agree, and the hard ones that break graphs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import FrameSpec, MarkerSpec, ModelCard, Sensor
from service.contract.model_card import Lattice

PITCH_PX, RADIUS_PX = Sensor.load().marker_pitch_px, Sensor.load().marker_diameter_px / 2


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
    """Inputs that no camera should send but one eventually will; each uint8 [count, 2, H, W, 3]."""
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


def golden_markers(spec: MarkerSpec | Lattice, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Marker fields that shear and twist over time, some markers invisible: float32 [count, 2, rows, columns, 3]."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: spec.rows, : spec.columns].astype(np.float32)
    motion = rng.uniform(-1.0, 1.0, (2, 3, 1, 1))
    fields = np.ones((count, 2, spec.rows, spec.columns, 3), np.float32)
    for index in range(count):
        for finger in range(2):
            shift_u, shift_v, twist = motion[finger] * index
            fields[index, finger, ..., 0] = shift_u - 0.15 * twist * (v - spec.rows / 2)
            fields[index, finger, ..., 1] = shift_v + 0.15 * twist * (u - spec.columns / 2)
    fields[..., :2] += rng.normal(0, 0.05, fields[..., :2].shape)
    fields[rng.random(fields.shape[:-1]) < 0.02] = 0.0
    return fields


def hard_markers(spec: MarkerSpec | Lattice, count: int) -> dict[str, NDArray[np.float32]]:
    """Fields that no tracker should give but one eventually will; each float32 [count, 2, rows, columns, 3]."""
    still = np.repeat(golden_markers(spec, 1), count, axis=0)
    spark, torn, left = still.copy(), still.copy(), np.zeros_like(still)
    left[1:, 0, spec.rows // 2, spec.columns // 2] = 1.0
    left[0, 0, spec.rows // 2, spec.columns // 2, 2] = 1.0
    spark[1:, 0, spec.rows // 2, spec.columns // 2, 0] = 100.0
    torn[1::2, ..., :2] = 1e4
    return {
        "no difference": still,
        "single leaping marker": spark,
        "one marker left": left,
        "nothing seen": np.zeros_like(still),
        "torn off and back in turn": torn,
        "denormals": still * np.float32(1e-40),
        "noise": np.random.default_rng(1).normal(0, 300, still.shape).astype(np.float32),
    }


def _grid(card: ModelCard) -> MarkerSpec | Lattice | None:
    return card.pressing.lattice if card.pressing else card.markers


def golden_input(card: ModelCard, seed: int = 0) -> NDArray[Any]:
    """A golden decision as the input of the card's graph: [frames_per_decision, 2, *input_shape]."""
    if grid := _grid(card):
        return golden_markers(grid, card.frames_per_decision, seed)
    return golden_frames(card.frame, card.frames_per_decision, seed)


def hard_input(card: ModelCard) -> dict[str, NDArray[Any]]:
    """The hard decisions of the card's kind of input, by name."""
    if grid := _grid(card):
        return dict(hard_markers(grid, card.frames_per_decision))
    return dict(hard_frames(card.frame, card.frames_per_decision))
