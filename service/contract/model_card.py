"""The model card: everything the service must know of a network, inside the ONNX file it describes.

One ``metadata_props`` key holds strict JSON. Other tools' keys beside it are ignored; unknown keys inside it are
refused. The service refuses a model without a valid card, and two models whose cards disagree.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, JsonValue, ValidationError, model_validator

from service.contract.frames import Contract, ContractError, FrameSpec, differing, first_error
from service.contract.sensor import MarkerSpec, Sensor

CARD_KEY = "tactile_insertion.card"
UNTRAINED = "untrained"  # in ``training_run``: why an exported network is no better than guessing

Sign = Literal[-1, 0, 1]
Role = Literal["direction", "magnitude", "joint", "pair"]
Positive = Annotated[float, Field(gt=0)]
Bounded = Annotated[float, Field(gt=0, lt=15)]  # within the errors that are trained on, or a class has none of them


CONDITIONS = ("gap_width_mm", "grasp_height_mm", "grip_n", "shear_reach_mm", "speed_mm_s", "frame_spacing_mm")
"""Conditions that may be stated besides the field, in the order of the graph's input; 0 if unknown.

``shear_reach_mm`` is the shear of the gel at which it slides (mu p t / G); ``frame_spacing_mm`` the arm's travel from
frame to frame, which the service measures itself.
"""
MARKER_PITCH = "marker_pitch_mm"
"""Also has a trained range, although no graph reads it."""


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
    """Training range of a network for one quantity, both ends included."""

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

    def reads_like(self, other: Self) -> bool:
        """Whether both read the same steps of depth; the ranges that they were trained on may differ."""
        ranges = {"trained", "strangeness_limit"}
        return self.model_dump(exclude=ranges) == other.model_dump(exclude=ranges)

    @property
    def depth_mm(self) -> float:
        """Travel of the press for a whole decision."""
        return self.steps_n * self.step_mm

    def outside(self, conditions: Mapping[str, float | None]) -> str:
        """Which condition lies outside the network's training range, as a sentence; empty if none does.

        An unstated condition is not outside; a non-finite one is.
        """
        for name, span in self.trained.items():
            value = conditions.get(name)
            if value is not None and not span.low <= value <= span.high:
                return f"{name} is {value:g}, the networks were trained on {span.low:g} to {span.high:g}"
        return ""


class ErrorClass(Contract):
    """One class of DirectionNN: its name and the signs (S_x, S_theta) of the position error it stands for."""

    name: str
    sign_x: Sign
    sign_theta: Sign


class Calibration(Contract):
    """Fitted on validation data: logits are divided by ``temperature``, sigmas multiplied by the scales."""

    temperature: Positive = 1.0
    sigma_scale_x: Positive = 1.0
    sigma_scale_theta: Positive = 1.0


class Expectations(Contract):
    """What a belief expects of attempts with these networks: measured in the closed loop, not learnt. Pairs: mm, deg.

    ``edge`` of the errors at the start; ``spread`` of the errors trained on, which a stated sigma includes;
    ``tolerance`` of a pose that inserts. A blocked object is left turned outwards in the hand: by ``creep_mm``, nearer
    than ``near_mm`` to the gap by ``creep_near_mm`` and so much more per mm that it is held higher than 30 mm, each
    with its spread. The defaults are those of the first release, which pressed until slip.
    """

    edge: tuple[Positive, Positive] = (19.0, 16.0)
    spread: tuple[Positive, Positive] = (9.0, 8.7)
    tolerance: tuple[Bounded, Bounded] = (2.0, 3.5)
    near_mm: Positive = 5.0
    creep_mm: float = Field(default=0.45, ge=-5.0, le=5.0)
    creep_near_mm: float = Field(default=0.28, ge=-5.0, le=5.0)
    creep_near_mm_per_mm: float = Field(default=0.022, ge=-0.2, le=0.2)
    creep_spread_mm: Positive = 0.35
    creep_near_more_mm: float = Field(default=0.35, ge=0.0, le=5.0)
    creep_theta_deg: Positive = 0.3


class SelfTest(Contract):
    """The outputs on fixed frames where the network was released; see :mod:`service.contract.self_test`."""

    outputs: dict[str, tuple[float, ...]]
    tolerance: Positive


class ModelCard(Contract):
    """The card of one ONNX file.

    ``sensor`` is the profile of the fingers it was made for; cards without one are older than the field, see
    :attr:`profile`.

    Graph inputs, by form (uint8 frames, preprocessing inside the graph, batch B free):

    - ``sequence``: ``frames`` uint8 [B, frames_per_decision, 2, H, W, 3]
    - ``step``: ``frame`` uint8 [B, 2, H, W, 3], ``reference`` uint8 [B, 2, H, W, 3],
      ``state`` float32 [B, state_size]
    - with ``markers``, fingers are not pictures but marker fields: float32 [.., 2, rows, columns, 3] in place of uint8
      [.., 2, H, W, 3], each marker (du_px, dv_px, 1 or 0 if it was not seen), displaced since any one instant
    - with ``pressing``, fingers are fields on its lattice, a step of depth each: float32 [.., 2, rows, columns, 3] of
      (du_mm, dv_mm, 1 or 0 if it was not seen), and ``conditions`` float32 [B, 6] come with them, 0 where not known
    - both, if ``gap_width_input``: ``gap_width_mm`` float32 [B, 1]
    - both, if ``grasp_height_input``: ``grasp_height_mm`` float32 [B, 1], 0 where it is not known

    Outputs: ``direction`` -> ``logits`` float32 [B, len(classes)]; ``magnitude`` -> ``error`` float32 [B, 2]
    (dx in mm, dtheta in deg: the estimated position error) and, if ``has_sigma``, ``log_sigma`` float32 [B, 2];
    ``pair`` -> all three, from one pass; ``joint`` -> ``log_density`` float32 [B, len(grid_x_mm),
    len(grid_theta_deg)], unnormalised. A ``pressing`` with a limit adds ``strangeness`` float32 [B, 1]. ``step`` adds
    ``next_state`` float32 [B, state_size]. The two fingers are ordered left, right. A fresh state is all zeros.
    """

    schema_version: Literal[1] = 1
    name: str
    role: Role
    form: Literal["sequence", "step"]
    frame: FrameSpec
    markers: MarkerSpec | None = None
    pressing: Pressing | None = None
    sensor: Sensor | None = None
    frames_per_decision: int = Field(ge=1, le=64)
    state_size: int = Field(ge=0, default=0)
    reference_rule: Literal["first_of_sequence"] = "first_of_sequence"
    classes: tuple[ErrorClass, ...]
    threshold_x_mm: Bounded = 2.5
    threshold_theta_deg: Bounded = 5.0
    gap_width_input: bool = False
    grasp_height_input: bool = False
    has_sigma: bool = False
    grid_x_mm: tuple[float, ...] = ()
    grid_theta_deg: tuple[float, ...] = ()
    calibration: Calibration = Calibration()
    expectations: Expectations = Expectations()
    min_confidence: float = Field(ge=0, le=1, default=0.0)
    training_data_sha256: str
    git_commit: str
    training_run: dict[str, JsonValue] = Field(default_factory=dict)
    quantisation: Literal["none", "int8"] = "none"
    validation: dict[str, float]
    verified_on_cpu: str
    self_test: SelfTest | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.role in ("direction", "pair") and len(self.classes) < 2:
            raise ValueError(f"a {self.role} network needs at least two classes")
        if len({c.name for c in self.classes}) != len(self.classes):
            raise ValueError("class names repeat")
        if len({(c.sign_x, c.sign_theta) for c in self.classes}) != len(self.classes):
            raise ValueError("classes: two have the same signs")
        if self.role == "joint" and (len(self.grid_x_mm) < 2 or len(self.grid_theta_deg) < 2):
            raise ValueError("a joint network needs grid_x_mm and grid_theta_deg")
        if any(
            not later > before for grid in (self.grid_x_mm, self.grid_theta_deg) for before, later in pairwise(grid)
        ):
            raise ValueError("grid_x_mm and grid_theta_deg must rise")
        if self.form == "step" and self.state_size == 0:
            raise ValueError("a step network needs a state_size")
        if self.pressing and (self.markers or self.frames_per_decision != self.pressing.steps_n):
            raise ValueError(
                "a network that reads steps of depth reads no markers, and a frame of a decision is a step"
            )
        if self.sensor and (self.frame != self.sensor.rectified or self.markers not in (None, self.sensor.markers)):
            raise ValueError(f"frame and markers must be those of its sensor {self.sensor}")
        return self

    @property
    def profile(self) -> Sensor:
        """The sensor it was made for; for old cards without the field, the only sensor of that time."""
        return self.sensor or Sensor.load()

    @property
    def input_shape(self) -> tuple[int, int, int]:
        """Input shape of the graph for one finger at one instant: (H, W, 3) or (rows, columns, 3)."""
        if self.pressing:
            return (self.pressing.lattice.rows, self.pressing.lattice.columns, 3)
        return (self.markers.rows, self.markers.columns, 3) if self.markers else self.frame.shape

    @property
    def reads(self) -> str:
        """Its input, in words."""
        return "steps of depth" if self.pressing else "markers" if self.markers else "pictures"

    @property
    def input_dtype(self) -> type[np.uint8 | np.float32]:
        """Uint8 for pictures, float32 for fields."""
        return np.float32 if self.markers or self.pressing else np.uint8

    def check(self, pair: NDArray[np.uint8] | NDArray[np.float32]) -> None:
        """Raise ContractError unless ``pair`` is [2, *input_shape] of the right dtype, and finite."""
        if pair.shape != (2, *self.input_shape) or pair.dtype != self.input_dtype:
            expected = f"{np.dtype(self.input_dtype)} {[2, *self.input_shape]}"
            raise ContractError(f"a pair is {pair.dtype} {list(pair.shape)}, {self.name} reads {expected}")
        if self.input_dtype is np.float32 and not np.isfinite(pair).all():
            raise ContractError(f"a marker field holds a number that is not finite, {self.name} cannot read it")

    @classmethod
    def from_props(cls, props: Mapping[str, str], source: str = "model") -> Self:
        """Read the card out of ONNX ``metadata_props``; raise ContractError if it is absent or invalid."""
        if CARD_KEY not in props:
            raise ContractError(f"{source} carries no model card ({CARD_KEY}); export it with `python -m export onnx`")
        try:
            return cls.model_validate_json(props[CARD_KEY])
        except ValidationError as error:
            raise ContractError(f"{source} has an invalid model card: {first_error(error, 'card')}") from error

    def to_props(self) -> dict[str, str]:
        """The single ``metadata_props`` entry that :meth:`from_props` reads back."""
        return {CARD_KEY: self.model_dump_json()}

    def disagreements(self, other: Self) -> list[str]:
        """Fields on which two cards that must serve one decision differ, as sentences; empty if they agree."""
        if self.reads != other.reads:
            return [f"input: {self.name} reads {self.reads}, {other.name} reads {other.reads}"]
        read = ("frame", "markers", "pressing", "profile", "frames_per_decision", "form")
        shared = (*read, "threshold_x_mm", "threshold_theta_deg")
        pairs = {field: (getattr(self, field), getattr(other, field)) for field in shared}
        return [
            f"{field}: {self.name} says {differing(mine, theirs)}, {other.name} says {differing(theirs, mine)}"
            for field, (mine, theirs) in pairs.items()
            if mine != theirs
        ]

    def incomparable(self, other: Self) -> list[str]:
        """As `disagreements`, with a card that answers beside this one: each keeps to its own trained ranges."""
        if self.pressing and other.pressing and self.pressing.reads_like(other.pressing):
            other = other.model_copy(update={"pressing": self.pressing})
        return self.disagreements(other)
