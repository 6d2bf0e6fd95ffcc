"""A network's self-test: its outputs on fixed frames at its release, compared wherever it is loaded.

An int8 build that saturates on a processor without VNNI, or a runtime that computes differently, is silently wrong;
this test detects it. The frames are integers made from integers, so they are the same on every machine.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract.frames import ContractError, FrameSpec
from service.contract.model_card import Lattice, ModelCard, SelfTest
from service.contract.sensor import MarkerSpec, Sensor

Arrays = dict[str, NDArray[Any]]
Run = Callable[[Arrays], Mapping[str, NDArray[Any]]]
CONDITIONS = (56.0, 40.0, 20.0, 0.8, 10.0, 0.33)
MM = 0.0625
"""The size of a pixel where fields are in mm: a power of two, so that it adds no rounding."""
GEOMETRY_MM = {"gap_width_mm": 56.0, "grasp_height_mm": 40.0}
MOST_VALUES = 32
TOLERANCE = {"none": 1e-3, "int8": 5e-2}
"""Largest difference between two machines, relative to the largest output or one: it allows only rounding."""


def self_test_frames(sensor: Sensor, spec: FrameSpec, count: int) -> NDArray[np.uint8]:
    """Dotted frames that shear by a pixel per frame, the fingers in opposite directions: uint8 [count, 2, H, W, 3]."""
    v, u = np.mgrid[: spec.height_px, : spec.width_px]
    step = np.arange(count)[:, None, None, None]
    way = np.array([1, -1])[None, :, None, None]
    pitch_px = round(sensor.marker_pitch_px)
    off_u = (u + step * way) % pitch_px - pitch_px // 2
    off_v = (v + step // 2) % pitch_px - pitch_px // 2
    level = np.where(off_u**2 + off_v**2 <= (sensor.marker_diameter_px / 2) ** 2, 60, 140 + u // 32)
    return np.stack([level - 30, level, level - 20], -1).astype(np.uint8)


def self_test_markers(spec: MarkerSpec | Lattice, count: int) -> NDArray[np.float32]:
    """The same motion as marker fields, every 19th marker invisible: float32 [count, 2, rows, columns, 3]."""
    v, u = np.mgrid[: spec.rows, : spec.columns]
    step = np.arange(count)[:, None, None, None]
    way = np.array([1, -1])[None, :, None, None]
    visible = np.broadcast_to((v * spec.columns + u) % 19 != 0, (count, 2, spec.rows, spec.columns))
    du, dv = -(step * way) * (1 + v / spec.rows), step / 2 + u * 0
    return np.asarray(np.stack(np.broadcast_arrays(du, dv, visible), -1) * visible[..., None], np.float32)


def self_test_input(card: ModelCard) -> NDArray[Any]:
    """The fixed decision as input of the card's graph: [frames_per_decision, 2, *input_shape]."""
    if card.markers:
        return self_test_markers(card.markers, card.frames_per_decision)
    if card.pressing:
        fields = self_test_markers(card.pressing.lattice, card.frames_per_decision)
        return fields * np.array([MM, MM, 1], np.float32)
    return self_test_frames(card.profile, card.frame, card.frames_per_decision)


def run_self_test(card: ModelCard, run: Run) -> dict[str, tuple[float, ...]]:
    """At most 32 values of each decision output on the fixed frames, by either form; ``run`` maps inputs to outputs."""
    frames = self_test_input(card)[None]
    asked = {"gap_width_mm": card.gap_width_input, "grasp_height_mm": card.grasp_height_input}
    geometry: Arrays = {
        name: np.full((1, 1), GEOMETRY_MM[name], np.float32) for name, wanted in asked.items() if wanted
    }
    if card.pressing:
        geometry["conditions"] = np.array([CONDITIONS], np.float32)
    if card.form == "sequence":
        outputs = dict(run({"frames": frames, **geometry}))
    else:
        state: NDArray[Any] = np.zeros((1, card.state_size), np.float32)
        for step in range(card.frames_per_decision):
            outputs = dict(run({"frame": frames[:, step], "reference": frames[:, 0], "state": state, **geometry}))
            state = outputs.pop("next_state")
    return {name: tuple(float(number) for number in _spread(value)) for name, value in outputs.items()}


def make_self_test(card: ModelCard, run: Run) -> SelfTest:
    """The test for a card: run it where the network is released."""
    return SelfTest(outputs=run_self_test(card, run), tolerance=TOLERANCE[card.quantisation])


def check_self_test(card: ModelCard, run: Run, source: str) -> None:
    """Raise ContractError, naming output and difference, if a network computes differently than at its release.

    A card without a test passes unless it is int8: only those builds depend on the processor.
    """
    if card.self_test is None:
        if card.quantisation == "int8":
            raise ContractError(f"{source} is int8 and its card holds no self-test; quantise it again")
        return
    got = run_self_test(card, run)
    for name, wanted in card.self_test.outputs.items():
        computed = np.asarray(got.get(name, ()), np.float64)
        expected = np.asarray(wanted, np.float64)
        if computed.shape != expected.shape:
            raise ContractError(f"{source}: self-test gives {computed.size} values of {name}, expected {expected.size}")
        gap = float(np.abs(computed - expected).max() / max(1.0, float(np.abs(expected).max())))
        if not gap <= card.self_test.tolerance:
            raise ContractError(
                f"{source}: self-test output {name} is off by {gap:.1e}, expected at most {card.self_test.tolerance:g}:"
                " this processor or runtime computes otherwise than the one it was released on"
            )


def _spread(value: NDArray[Any]) -> NDArray[np.float64]:
    flat = np.asarray(value, np.float64).ravel()
    chosen: NDArray[np.float64] = flat[np.linspace(0, flat.size - 1, min(flat.size, MOST_VALUES)).astype(int)]
    return chosen
