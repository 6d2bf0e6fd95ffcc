"""What a network reads that knows depth instead of frames: the gel's motion on fixed points, a step of depth at a time.

Frame rate, speed and marker grid differ from cell to cell; how far the object was pressed onto the block does not.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from service.contract.frames import Contract

Positive = Annotated[float, Field(gt=0)]

CONDITIONS = ("gap_width_mm", "grasp_height_mm", "grip_n", "shear_reach_mm", "speed_mm_s", "frame_spacing_mm")
"""What may be told beside the field, in the order of the graph's input; 0 where it is not known.

``shear_reach_mm`` is how far the gel shears before it slides (mu p t / G); ``frame_spacing_mm`` how far the arm moves
from frame to frame, which the service knows itself.
"""
MARKER_PITCH = "marker_pitch_mm"
"""Also has a trained range, though no graph reads it."""


class Lattice(Contract):
    """Points on the gel, ``pitch_mm`` apart, centred on the rectified frame; u to the right, v down."""

    rows: int = Field(ge=4, le=64)
    columns: int = Field(ge=4, le=64)
    pitch_mm: Positive

    @property
    def points_mm(self) -> NDArray[np.float32]:
        """[rows, columns, 2]: (u, v) of each point from the frame's centre."""
        u = (np.arange(self.columns) - 0.5 * (self.columns - 1)) * self.pitch_mm
        v = (np.arange(self.rows) - 0.5 * (self.rows - 1)) * self.pitch_mm
        return np.stack(np.meshgrid(u, v), -1).astype(np.float32)


class Span(Contract):
    """What a network was trained on of one quantity, both ends included."""

    low: float
    high: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low <= self.high):
            raise ValueError(f"from {self.low} to {self.high} is no range")
        return self


class Pressing(Contract):
    """How a network reads a descent: ``steps_n`` steps of ``step_mm`` of depth since the object first moved.

    A field of a step is the mean over that stretch of depth, in mm against the field before the onset. With a stop
    before the last step the network decides from at least ``least_steps_n``. ``trained``: the range of each condition;
    outside it the service refuses. ``strangeness_limit``: above it a field is like none of training.
    """

    lattice: Lattice
    step_mm: Positive
    steps_n: int = Field(ge=1, le=64)
    least_steps_n: int = Field(ge=1, le=64, default=1)
    trained: dict[str, Span]
    strangeness_limit: Positive | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.least_steps_n > self.steps_n:
            raise ValueError(f"least_steps_n is {self.least_steps_n}, more than all {self.steps_n} steps")
        unknown = set(self.trained) - {*CONDITIONS, MARKER_PITCH}
        if unknown:
            raise ValueError(
                f"trained: {', '.join(sorted(unknown))} is none of {', '.join((*CONDITIONS, MARKER_PITCH))}"
            )
        return self

    @property
    def depth_mm(self) -> float:
        """How far the object is pressed for a whole decision."""
        return self.steps_n * self.step_mm

    def outside(self, told: Mapping[str, float | None]) -> str:
        """Which condition lies outside what the network was trained on, as a sentence; empty if none does.

        What is not told is not outside; a number that is not finite is.
        """
        for name, span in self.trained.items():
            value = told.get(name)
            if value is not None and not span.low <= value <= span.high:
                return f"{name} is {value:g}, the networks were trained on {span.low:g} to {span.high:g}"
        return ""
