"""Scene: a world with an object in it, everything about one simulated cell that is not motion.

`simulation.scene.worlds` reads it from files. Units are in the names. Frames: see `shapes` (object) and the
work-object frame (origin at the gap's centre at the height of the block tops, x across the gap, y along it, z up).
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service.contract.refusals import describe
from simulation.scene import shapes

YOUNGER_KEYS = {
    "blocks": ("insertion_depth_mm",),
    "object": ("vertices_mm", "texture_period_mm", "texture_gain"),
    "camera": ("readout_ms",),
    "effects": ("inertia", "rolling_shutter"),
}
RECORD = ("training", "order", "paper", "target")  # keys that change nothing of the cell
Switch = Literal["auto", "on", "off"]


class SceneError(ValueError):
    """A scene that cannot be read or cannot exist; the text names the key and what is allowed."""


class Part(BaseModel):
    """Base of all parts of a scene: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class HeldObject(Part):
    """The object: footprint at its flat bottom, section where it is held (the same unless given), weight.

    A polygon states its convex bottom by vertices_mm, counter-clockwise; its sizes are their extent.
    The texture's period and gain (contrast of its relief, 0..1) follow from its name unless given.
    """

    shape: shapes.Outline
    vertices_mm: tuple[tuple[float, float], ...] | None = Field(default=None, min_length=3, max_length=32)
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
            return data
        try:
            x, y = np.ptp(np.asarray(data["vertices_mm"], np.float64), axis=0)
        except (ValueError, TypeError):
            return data  # the field itself says what is wrong
        return data | {"size_x_mm": float(x), "size_y_mm": float(y)}

    @property
    def footprint_mm(self) -> NDArray[np.float64]:
        """Bottom polygon [n, 2], mm, object frame."""
        if self.vertices_mm:
            return shapes.centred(self.vertices_mm)
        return shapes.footprint(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)

    @property
    def held_profile(self) -> NDArray[np.float64]:
        """Held surface as in `shapes.held_profile`, array [5], mm."""
        if self.held_shape is None and self.vertices_mm:
            return np.array([shapes.crest_mm(self.vertices_mm), 0.5 * self.size_x_mm, 1.0, 1.0, 0.0])
        if self.held_shape is None:
            return shapes.held_profile(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)
        size_x = self.held_size_x_mm or self.size_x_mm
        size_y = self.held_size_y_mm or self.size_y_mm
        return shapes.held_profile(self.held_shape, size_x, size_y, self.held_corner_radius_mm)

    @property
    def held_faces(self) -> NDArray[np.float64] | None:
        """Held sides of a polygon as in `shapes.faces`; None where `held_profile` says it all."""
        return shapes.faces(self.vertices_mm) if self.vertices_mm and self.held_shape is None else None


class Blocks(Part):
    """The two blocks that leave the gap. `free` lets them slide on the table and tip.

    ``insertion_depth_mm``: how deep all of an object's bottom face must be below their tops to count as inserted.
    """

    gap_mm: float = Field(gt=5.0, le=250.0)
    free: bool = False
    size_x_mm: float = Field(default=45.0, ge=5.0, le=500.0)
    size_y_mm: float = Field(default=155.0, ge=5.0, le=1000.0)
    height_mm: float = Field(default=60.0, ge=25.0, le=500.0)
    mass_kg: float = Field(default=0.6, gt=0.0, le=20.0)
    stiffness_n_per_mm: float = Field(default=1000.0, ge=5.0, le=50000.0)
    friction: float = Field(default=0.25, ge=0.0, le=2.0)
    table_friction: float = Field(default=0.4, ge=0.0, le=2.0)
    insertion_depth_mm: float = Field(default=15.0, ge=1.0, le=100.0)


class Gel(Part):
    """The two gel pads.

    A bristle's stiffness per area is G / thickness along the pad, normal_ratio times that into it.
    """

    tier: Literal["bristle", "layer"] = "bristle"
    thickness_mm: float = Field(default=2.5, ge=0.3, le=10.0)
    shear_modulus_n_per_mm2: float = Field(default=0.1, ge=0.005, le=5.0)
    normal_ratio: float = Field(default=3.0, ge=0.5, le=50.0)
    friction: float = Field(default=0.8, ge=0.0, le=2.0)
    crown_mm: float = Field(default=0.12, ge=0.0, le=1.0)
    wear: float = Field(default=0.1, ge=0.0, le=1.0)
    node_rows: int = Field(default=20, ge=4, le=120)
    node_columns: int = Field(default=21, ge=4, le=126)


class Grasp(Part):
    """How the object is held. Spreads are standard deviations over re-fixtures."""

    force_n: float = Field(default=20.0, ge=0.5, le=120.0)
    height_mm: float = Field(default=30.0, ge=5.0, le=150.0)
    pre_tilt_spread_deg: float = Field(default=0.5, ge=0.0, le=5.0)
    pre_yaw_spread_deg: float = Field(default=0.3, ge=0.0, le=5.0)
    force_limit_n: float = Field(default=60.0, ge=5.0, le=500.0)


class Camera(Part):
    """Geometry and noise of the finger cameras; images themselves are made by the renderer."""

    fps: Literal[30, 60, 90] = 30
    mm_per_px: float = Field(default=0.07, ge=0.02, le=0.3)
    raw_width_px: Literal[427] = 427
    raw_height_px: Literal[320] = 320
    width_px: Literal[327] = 327
    height_px: Literal[320] = 320
    marker_columns: Literal[21] = 21
    marker_rows: Literal[20] = 20
    marker_pitch_px: float = Field(default=15.0, ge=8.0, le=30.0)
    marker_diameter_px: float = Field(default=5.0, ge=2.0, le=12.0)
    noise_grey: float = Field(default=2.0, ge=0.0, le=30.0)
    exposure: float = Field(default=1.0, ge=0.3, le=3.0)
    exposure_ms: float = Field(default=8.0, ge=0.1, le=33.0)
    readout_ms: float = Field(default=0.0, ge=0.0, le=33.0)
    light: float = Field(default=1.0, ge=0.2, le=3.0)
    dropped_share: float = Field(default=0.0, ge=0.0, le=0.5)


class Numerics(Part):
    """What buys accuracy with time."""

    load_step_mm: float = Field(default=0.17, ge=0.001, le=1.0)
    residual_n: float = Field(default=1e-7, ge=1e-12, le=1e-3)
    slip_share: float = Field(default=0.25, gt=0.0, le=1.0)


class Effects(Part):
    """`auto` follows the predicate in `simulation.scene.effects`; `on` and `off` force it."""

    gravity: Switch = "auto"
    inertia: Switch = "auto"
    edge_friction: Switch = "auto"
    free_blocks: Switch = "auto"
    gel_wear: Switch = "auto"
    gel_coupling: Switch = "auto"
    object_texture: Switch = "auto"
    motion_blur: Switch = "auto"
    rolling_shutter: Switch = "auto"
    camera_noise: Switch = "auto"
    dropped_frames: Switch = "auto"


class Figures(Part):
    """Success, 0..1, and mean and largest number of trials of one object; a failure counts as 16 trials."""

    success: float = Field(ge=0.0, le=1.0)
    mean_trials: float = Field(ge=1.0, le=16.0)
    max_trials: int | None = Field(default=None, ge=1, le=16)


class Scene(Part):
    """One simulated cell. Frozen; make variants with `varied` or `randomisation.randomised`.

    ``training``: the released networks were trained on this object. ``order``: its place in tables, which seeds follow.
    ``paper``: what the paper measured on the real robot. ``target``: what this project set out to reach.
    """

    name: str = Field(min_length=1)
    training: bool = False
    order: int | None = Field(default=None, ge=0)
    paper: Figures | None = None
    target: Figures | None = None
    object: HeldObject
    blocks: Blocks
    gel: Gel = Gel()
    grasp: Grasp = Grasp()
    camera: Camera = Camera()
    numerics: Numerics = Numerics()
    effects: Effects = Effects()
    speed_mm_s: float = Field(default=10.0, gt=0.0, le=200.0)
    x_range_mm: float = Field(default=15.0, gt=0.0, le=60.0)
    theta_range_deg: float = Field(default=15.0, gt=0.0, le=45.0)

    @model_validator(mode="after")
    def _polygon_can_exist(self) -> Self:
        if (self.object.shape == "polygon") != (self.object.vertices_mm is not None):
            raise ValueError("object.vertices_mm: expected with shape = 'polygon', and with no other shape")
        corners = self.object.vertices_mm
        if corners and not shapes.is_convex(corners):
            raise ValueError("object.vertices_mm: expected corners of a convex polygon, counter-clockwise")
        if corners and self.object.corner_radius_mm > 0.0:
            raise ValueError("object.corner_radius_mm: a polygon has none")
        return self

    @model_validator(mode="after")
    def _can_exist(self) -> Self:
        body = self.object
        if self.blocks.gap_mm <= body.size_x_mm:
            raise ValueError(f"blocks.gap_mm: {self.blocks.gap_mm} must exceed object.size_x_mm {body.size_x_mm}")
        if body.corner_radius_mm > 0.5 * (least := min(body.size_x_mm, body.size_y_mm)):
            raise ValueError(f"object.corner_radius_mm: must be 0 to {0.5 * least:g}, half of the smaller size")
        if body.held_corner_radius_mm > 0.5 * (body.held_size_x_mm or body.size_x_mm):
            raise ValueError("object.held_corner_radius_mm: must be at most half of the held section's width")
        if self.gel.crown_mm > 0.5 * self.gel.thickness_mm:
            raise ValueError(f"gel.crown_mm: must be 0 to {0.5 * self.gel.thickness_mm:g}, half of gel.thickness_mm")
        if self.gel.tier == "layer" and self.gel.normal_ratio < 2.0:
            raise ValueError("gel.normal_ratio: must be at least 2 in the layer tier, where rubber pushes sideways too")
        if self.gel.tier == "layer" and self.effects.gel_coupling == "on":
            raise ValueError("effects.gel_coupling: the layer tier couples by itself; expected 'auto' or 'off'")
        if body.held_profile[1] + body.held_profile[2] < 3.0:
            raise ValueError("object.held_size_x_mm: the held section must be at least 6 mm wide")
        return self

    @property
    def clearance_mm(self) -> float:
        """Free space on each side of a centred object, mm."""
        return 0.5 * (self.blocks.gap_mm - self.object.size_x_mm)

    @property
    def marker_pitch_mm(self) -> float:
        """Distance of neighbouring markers on the gel, mm."""
        return self.camera.marker_pitch_px * self.camera.mm_per_px

    def identity_json(self) -> str:
        """Everything about the cell, as one line of JSON: what data sets know it by.

        A key younger than the first data sets counts only where it is set, so that they keep their scenes.
        """
        left_out: dict[str, Any] = dict.fromkeys(RECORD, True)
        for part, keys in YOUNGER_KEYS.items():
            values = getattr(self, part)
            fields = type(values).model_fields
            left_out[part] = {key for key in keys if getattr(values, key) == fields[key].default}
        return self.model_dump_json(exclude=left_out)

    @property
    def number(self) -> int:
        """What the seeds of this object's draws start from: its order or, without one, a number of its contents."""
        return zlib.crc32(self.identity_json().encode()) if self.order is None else self.order

    def fits(self, x_mm: float, theta_deg: float) -> bool:
        """Whether a vertical descent from this error inserts without touching (paper_facts' criterion)."""
        foot = self.object.footprint_mm if x_mm >= 0.0 else -self.object.footprint_mm
        return abs(x_mm) + shapes.half_width_mm(foot, theta_deg) <= 0.5 * self.blocks.gap_mm

    def varied(self, changes: Mapping[str, Any]) -> Scene:
        """A copy with dotted keys replaced, e.g. {"gel.friction": 0.5}. Raises SceneError."""
        data = self.model_dump()
        for key, value in changes.items():
            put(data, key, value)
        return parsed(data, self.name)


def put(data: dict[str, Any], dotted: str, value: Any) -> None:
    """Set a dotted key of nested tables. Raises SceneError."""
    *parents, last = dotted.split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise SceneError(f"{dotted}: {parent} has no keys below it")
    data[last] = value


def parsed(data: Mapping[str, Any], source: str) -> Scene:
    """The scene that tables read from ``source`` describe. Raises SceneError."""
    try:
        return Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(f"{source}: {describe(error, Scene)}") from error
