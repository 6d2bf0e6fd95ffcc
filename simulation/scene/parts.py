"""The tables of a scene: the object, the blocks, the gel, the grasp, the cameras, numerics and effects."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from service.contract import Sensor
from simulation.scene import shapes

Switch = Literal["auto", "on", "off"]
Margin = Annotated[float, Field(ge=0.0, le=1000.0)]
Listed = Field(strict=False)  # TOML has lists, no tuples; their members are strict
Corner = Annotated[tuple[float, float], Listed]
HELD = ("held_size_x_mm", "held_size_y_mm", "held_corner_radius_mm")


class Part(BaseModel):
    """Base of all parts of a scene: frozen; unknown keys are errors, and so are numbers in quotes or true for 1."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class HeldObject(Part):
    """The object: footprint at its flat bottom, section where it is held (the same unless given), weight.

    A polygon states its convex bottom by vertices_mm, counter-clockwise; its sizes follow from them and
    corner_radius_mm. A hexagon has two corners on x. It is regular where both sizes are equal; else they are its
    extents. Held sizes without held_shape are those of the same shape. The texture's period and gain (contrast of its
    relief, 0..1) follow from its name unless given.
    """

    shape: shapes.Outline
    vertices_mm: tuple[Corner, ...] | None = Field(default=None, min_length=3, max_length=32, strict=False)
    size_x_mm: float = Field(gt=5.0, le=200.0)
    size_y_mm: float = Field(gt=5.0, le=110.0)
    corner_radius_mm: float = Field(default=0.0, ge=0.0, le=50.0)
    held_shape: shapes.Shape | None = None
    held_size_x_mm: float | None = Field(default=None, gt=5.0, le=200.0)
    held_size_y_mm: float | None = Field(default=None, gt=5.0, le=110.0)
    held_corner_radius_mm: float = Field(default=0.0, ge=0.0, le=50.0)
    mass_kg: float = Field(default=0.08, gt=0.0, le=5.0)
    centre_of_mass_height_mm: float = Field(default=30.0, ge=0.0, le=300.0)
    texture: Literal["smooth", "paper", "ribbed", "label", "layers"] = "smooth"
    texture_period_mm: float | None = Field(default=None, ge=0.1, le=10.0)
    texture_gain: float | None = Field(default=None, ge=0.0, le=0.5)

    @model_validator(mode="before")
    @classmethod
    def _sizes_of_a_polygon(cls, data: Any) -> Any:
        if not (isinstance(data, dict) and data.get("vertices_mm")):
            if isinstance(data, dict) and data.get("shape") == "polygon":
                raise ValueError("vertices_mm: missing, expected the corners [x, y] of a polygon")
            return data
        x, y = 0.0, 0.0
        for radius_mm in (0.0, data.get("corner_radius_mm", 0.0)):
            try:
                x, y = np.ptp(shapes.rounded(data["vertices_mm"], float(radius_mm)), axis=0)
            except (ValueError, TypeError, IndexError):
                break  # the field's own validation names the error
        if not x:
            return data
        return data | {"size_x_mm": float(x), "size_y_mm": float(y)}

    @model_validator(mode="before")
    @classmethod
    def _held_in_the_same_shape(cls, data: Any) -> Any:
        """Held sizes without a held shape are those of the object's own, with its corner radius."""
        if not isinstance(data, dict) or data.get("held_shape") or data.get("shape") == "polygon":
            return data
        if not any(data.get(name) for name in HELD):
            return data
        radius_mm = data.get("held_corner_radius_mm", data.get("corner_radius_mm", 0.0))
        return data | {"held_shape": data.get("shape"), "held_corner_radius_mm": radius_mm}

    @property
    def footprint_mm(self) -> NDArray[np.float64]:
        """Bottom polygon [n, 2], mm, object frame."""
        if self.vertices_mm:
            return shapes.centred(shapes.rounded(self.vertices_mm, self.corner_radius_mm))
        return shapes.footprint(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)

    @property
    def held_profile(self) -> NDArray[np.float64]:
        """Held surface as in `shapes.held_profile`, array [5], mm."""
        if (section := self._held_polygon) is not None:
            return np.array([shapes.crest_mm(section), 0.5 * float(np.ptp(section[:, 0])), 1.0, 1.0, 0.0])
        if self.held_shape is None:
            return shapes.held_profile(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)
        return shapes.held_profile(self.held_shape, *self.held_sizes_mm, self.held_corner_radius_mm)

    @property
    def held_width_mm(self) -> float:
        """Distance of the held sides, mm, and so of the fingers' pads."""
        return 2.0 * float(self.held_profile[0])

    @property
    def held_faces(self) -> NDArray[np.float64] | None:
        """Held sides of a polygon as in `shapes.faces`; None where `held_profile` describes it completely."""
        section = self._held_polygon
        return None if section is None else shapes.faces(section)

    @property
    def _held_polygon(self) -> NDArray[np.float64] | None:
        """The held section [n, 2], mm, where edges define it."""
        if self.held_shape is not None:
            return shapes.held_polygon(self.held_shape, *self.held_sizes_mm, self.held_corner_radius_mm)
        if self.vertices_mm:
            return shapes.rounded(self.vertices_mm, self.corner_radius_mm)
        return shapes.held_polygon(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)

    @property
    def held_sizes_mm(self) -> tuple[float, float]:
        """Sizes of the held section across the gap and along it, mm.

        A hexagon above a regular one, or above another shape, is regular.
        """
        x_mm = self.held_size_x_mm or self.size_x_mm
        regular = self.held_shape == "hexagon" and (self.shape != "hexagon" or self.size_x_mm == self.size_y_mm)
        return x_mm, self.held_size_y_mm or (x_mm if regular else self.size_y_mm)


class Blocks(Part):
    """The two blocks that form the gap. `free` lets them slide on the table and tip.

    ``insertion_depth_mm``: depth of an object's whole bottom face below their tops at which it counts as inserted.
    """

    gap_mm: float = Field(gt=5.0, le=250.0)
    free: bool = False
    size_x_mm: float = Field(default=45.0, ge=5.0, le=500.0)
    size_y_mm: float = Field(default=155.0, ge=5.0, le=1000.0)
    height_mm: float = Field(default=60.0, ge=25.0, le=500.0)
    mass_kg: float = Field(default=0.6, ge=1e-3, le=20.0)
    stiffness_n_per_mm: float = Field(default=1000.0, ge=5.0, le=50000.0)
    friction: float = Field(default=0.25, ge=0.0, le=2.0)
    table_friction: float = Field(default=0.4, ge=0.0, le=2.0)
    insertion_depth_mm: float = Field(default=15.0, ge=1.0, le=100.0)


class Gel(Part):
    """The two gel pads.

    A bristle's stiffness per area is G / thickness along the pad, and normal_ratio times that into it.
    ``poisson_ratio`` replaces normal_ratio where given. ``margin_mm`` (x along the gap's width, z up): extent of the
    gel beyond the outermost markers, where it ends in a free edge; endless unless given. ``relaxation_share`` of the
    stiffness, which is that of a quick motion, decays by exp(-t / relaxation_s) while a shape is held.
    """

    tier: Literal["bristle", "layer"] = "bristle"
    thickness_mm: float = Field(default=2.5, ge=0.3, le=10.0)
    shear_modulus_n_per_mm2: float = Field(default=0.1, ge=0.005, le=5.0)
    normal_ratio: float = Field(default=3.0, ge=0.5, le=50.0)
    poisson_ratio: float | None = Field(default=None, ge=0.0, le=0.4999)
    margin_mm: Annotated[tuple[Margin, Margin], Listed] | None = None
    relaxation_share: float = Field(default=0.0, ge=0.0, le=1.0)
    relaxation_s: float = Field(default=1.0, ge=1e-3, le=1e4)
    friction: float = Field(default=0.8, ge=0.0, le=2.0)
    crown_mm: float = Field(default=0.12, ge=0.0, le=1.0)
    wear: float = Field(default=0.1, ge=0.0, le=1.0)
    node_rows: int = Field(default=20, ge=4, le=120)
    node_columns: int = Field(default=21, ge=4, le=126)


class Grasp(Part):
    """How the object is held. Spreads are standard deviations over re-fixtures.

    ``finger_stiffness_n_per_mm``: stiffness of each finger against a force across the gap, at its pad; 0: rigid.
    """

    force_n: float = Field(default=20.0, ge=0.5, le=120.0)
    height_mm: float = Field(default=30.0, ge=5.0, le=150.0)
    pre_tilt_spread_deg: float = Field(default=0.5, ge=0.0, le=5.0)
    pre_yaw_spread_deg: float = Field(default=0.3, ge=0.0, le=5.0)
    force_limit_n: float = Field(default=60.0, ge=5.0, le=500.0)
    finger_stiffness_n_per_mm: float = Field(default=0.0, ge=0.0, le=1e6)


class Camera(Part):
    """The finger cameras: the sensor's profile and operating conditions. ``fps`` is the sensor's own unless given.

    ``sensor`` is a name or a TOML file; keys below a scene's `[camera.sensor]` override those of the default sensor.
    ``latency_ms``: delay until a frame arrives; it is stamped on arrival, not on exposure.
    ``used_share``: of the uneven light, flares, glue, debris and poor print of a GelSlim that was in use.
    """

    sensor: Sensor = Field(default_factory=Sensor.load)
    fps: int | float | None = Field(default=None, ge=10, le=120)
    noise_grey: float = Field(default=2.0, ge=0.0, le=30.0)
    exposure: float = Field(default=1.0, ge=0.3, le=3.0)
    exposure_ms: float = Field(default=8.0, ge=0.1, le=33.0)
    readout_ms: float = Field(default=0.0, ge=0.0, le=33.0)
    light: float = Field(default=1.0, ge=0.2, le=3.0)
    used_share: float = Field(default=0.0, ge=0.0, le=1.0)
    dropped_share: float = Field(default=0.0, ge=0.0, le=0.5)
    latency_ms: float = Field(default=0.0, ge=0.0, le=500.0)

    @field_validator("sensor", mode="before")
    @classmethod
    def _profile(cls, given: Any) -> Any:
        if isinstance(given, dict):
            return Sensor.load().model_dump() | given
        return Sensor.load(given) if isinstance(given, str | Path) else given


class Numerics(Part):
    """What buys accuracy with time. ``settle_mm``: where the nodes of a coupled pad no longer move between rounds."""

    load_step_mm: float = Field(default=0.17, ge=0.001, le=1.0)
    residual_n: float = Field(default=1e-7, ge=1e-12, le=1e-3)
    slip_share: float = Field(default=0.25, gt=0.0, le=1.0)
    settle_mm: float = Field(default=1e-6, ge=1e-9, le=1e-2)


class Effects(Part):
    """`auto` follows the predicate in `simulation.scene.effects`; `on` and `off` force it."""

    gravity: Switch = "auto"
    inertia: Switch = "auto"
    edge_friction: Switch = "auto"
    free_blocks: Switch = "auto"
    gel_wear: Switch = "auto"
    gel_coupling: Switch = "auto"
    poisson: Switch = "auto"
    gel_edges: Switch = "auto"
    relaxation: Switch = "auto"
    finger_compliance: Switch = "auto"
    object_texture: Switch = "auto"
    motion_blur: Switch = "auto"
    rolling_shutter: Switch = "auto"
    camera_noise: Switch = "auto"
    used_sensor: Switch = "auto"
    dropped_frames: Switch = "auto"


class Figures(Part):
    """Success, 0..1, and mean and largest number of trials of one object; a failure counts as 16 trials."""

    success: float = Field(ge=0.0, le=1.0)
    mean_trials: float = Field(ge=1.0, le=16.0)
    max_trials: int | None = Field(default=None, ge=1, le=16)
