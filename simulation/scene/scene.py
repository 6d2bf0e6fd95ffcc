"""Scene: everything about one simulated cell that is not motion, read from TOML and refused when impossible.

Units are in the names. Frames: see `shapes` (object) and the work-object frame (origin at the gap's centre
at the height of the block tops, x across the gap, y along it, z up).
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import to_json

from service.contract import ContractError, Sensor
from service.contract.toml import read_toml
from simulation.scene import shapes
from simulation.scene.errors import describe

OBJECTS = Path(__file__).parents[1] / "objects"
BUILT_IN = ("rectangle", "circle", "ellipse", "hexagon", "white_box", "vitamin", "can", "mustard")
YOUNGER_KEYS = (("camera", "readout_ms"), ("effects", "inertia"), ("effects", "rolling_shutter"))
FIRST_SENSOR_KEYS = (
    *("mm_per_px", "raw_width_px", "raw_height_px", "width_px", "height_px"),
    *("marker_columns", "marker_rows", "marker_pitch_px", "marker_diameter_px"),
)
Switch = Literal["auto", "on", "off"]


class SceneError(ValueError):
    """A scene that cannot be read or cannot exist; the text names the key and what is allowed."""


class Part(BaseModel):
    """Base of all parts of a scene: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class HeldObject(Part):
    """The object: footprint at its flat bottom, section where it is held (the same unless given), weight."""

    shape: shapes.Shape
    size_x_mm: float = Field(gt=5.0, le=200.0)
    size_y_mm: float = Field(gt=5.0, le=110.0)
    corner_radius_mm: float = Field(default=0.0, ge=0.0, le=50.0)
    held_shape: shapes.Shape | None = None
    held_size_x_mm: float | None = Field(default=None, gt=5.0, le=200.0)
    held_size_y_mm: float | None = Field(default=None, gt=5.0, le=110.0)
    held_corner_radius_mm: float = Field(default=0.0, ge=0.0, le=50.0)
    mass_kg: float = Field(default=0.08, gt=0.0, le=5.0)
    centre_of_mass_height_mm: float = Field(default=30.0, ge=0.0, le=300.0)
    texture: Literal["smooth", "paper", "ribbed", "label"] = "smooth"

    @property
    def footprint_mm(self) -> NDArray[np.float64]:
        """Bottom polygon [n, 2], mm, object frame."""
        return shapes.footprint(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)

    @property
    def held_profile(self) -> NDArray[np.float64]:
        """Held surface as in `shapes.held_profile`, array [5], mm."""
        if self.held_shape is None:
            return shapes.held_profile(self.shape, self.size_x_mm, self.size_y_mm, self.corner_radius_mm)
        size_x = self.held_size_x_mm or self.size_x_mm
        size_y = self.held_size_y_mm or self.size_y_mm
        return shapes.held_profile(self.held_shape, size_x, size_y, self.held_corner_radius_mm)


class Blocks(Part):
    """The two blocks that leave the gap. `free` lets them slide on the table and tip."""

    gap_mm: float = Field(gt=5.0, le=250.0)
    free: bool = False
    size_x_mm: float = Field(default=45.0, ge=5.0, le=500.0)
    size_y_mm: float = Field(default=155.0, ge=5.0, le=1000.0)
    height_mm: float = Field(default=60.0, ge=25.0, le=500.0)
    mass_kg: float = Field(default=0.6, gt=0.0, le=20.0)
    stiffness_n_per_mm: float = Field(default=1000.0, ge=5.0, le=50000.0)
    friction: float = Field(default=0.25, ge=0.0, le=2.0)
    table_friction: float = Field(default=0.4, ge=0.0, le=2.0)


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
    """The finger cameras: the sensor's profile, and how they are run. ``fps`` is the sensor's own unless given.

    ``sensor`` is a name or a TOML file; keys of it below a scene's `[camera.sensor]` replace those of the default one.
    """

    sensor: Sensor = Field(default_factory=Sensor.load)
    fps: int | None = Field(default=None, ge=10, le=120)
    noise_grey: float = Field(default=2.0, ge=0.0, le=30.0)
    exposure: float = Field(default=1.0, ge=0.3, le=3.0)
    exposure_ms: float = Field(default=8.0, ge=0.1, le=33.0)
    readout_ms: float = Field(default=0.0, ge=0.0, le=33.0)
    light: float = Field(default=1.0, ge=0.2, le=3.0)
    dropped_share: float = Field(default=0.0, ge=0.0, le=0.5)

    @field_validator("sensor", mode="before")
    @classmethod
    def _profile(cls, given: Any) -> Any:
        if isinstance(given, dict):
            return Sensor.load().model_dump() | given
        return Sensor.load(given) if isinstance(given, str | Path) else given


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


class Scene(Part):
    """One simulated cell. Frozen; make variants with `varied` or `randomised`."""

    name: str = Field(min_length=1)
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
    def sensor(self) -> Sensor:
        """The profile of both fingers."""
        return self.camera.sensor

    @property
    def fps(self) -> int:
        """Frames a second."""
        return self.camera.fps or self.sensor.fps

    def identity_json(self) -> str:
        """Everything the scene says, as one line of JSON: what data sets know it by.

        A key younger than the first data sets counts only where it is set, so that they keep their scenes. The sensor's
        numbers stand where they stood then, among the camera's; its name does not count.
        """
        left_out: dict[str, set[str]] = {"camera": {"sensor", "fps"}}
        for part, key in YOUNGER_KEYS:
            if getattr(getattr(self, part), key) == getattr(type(getattr(self, part))(), key):
                left_out.setdefault(part, set()).add(key)
        data = self.model_dump(exclude=left_out)
        sensor, usual = self.sensor.model_dump(exclude={"name", "fps"}), Sensor.load().model_dump()
        first = {key: sensor.pop(key) for key in FIRST_SENSOR_KEYS}
        younger = {key: value for key, value in sensor.items() if value != usual[key]}
        data["camera"] = {"fps": self.fps, **first, **data["camera"], **({"sensor": younger} if younger else {})}
        return to_json(data).decode()

    def fits(self, x_mm: float, theta_deg: float) -> bool:
        """Whether a vertical descent from this error inserts without touching (paper_facts' criterion)."""
        return abs(x_mm) + shapes.half_width_mm(self.object.footprint_mm, theta_deg) <= 0.5 * self.blocks.gap_mm

    def varied(self, changes: Mapping[str, Any]) -> Scene:
        """A copy with dotted keys replaced, e.g. {"gel.friction": 0.5}. Raises SceneError."""
        data = self.model_dump()
        for key, value in changes.items():
            _set(data, key, value)
        return _parse(data, self.name)

    def randomised(self, rng: np.random.Generator, *, held_out: bool = False) -> Scene:
        """A domain-randomised copy: what an installation meets that no scene file can know.

        How high above its bottom the object is held, its weight, grip and clearance are drawn from all that the cell
        can do. Sizes, frictions, stiffness, crown, grip, noise and light of held-out draws come from ranges that no
        training draw can reach. What a large scene scales past the limits of a scene stays at the limit.
        """

        def draw(low: float, high: float, margin: float) -> float:
            if not held_out:
                return float(rng.uniform(low, high))
            outer = (low - margin, low) if rng.random() < 0.5 else (high, high + margin)
            return float(rng.uniform(*outer))

        scale = draw(0.9, 1.2, 0.05)
        size_x = min(200.0, self.object.size_x_mm * scale)
        height = float(rng.uniform(25.0, 95.0))
        changes = {
            "object.size_x_mm": size_x,
            "object.size_y_mm": min(110.0, self.object.size_y_mm * scale * draw(0.96, 1.04, 0.04)),
            "object.corner_radius_mm": min(50.0, self.object.corner_radius_mm * scale),
            "object.mass_kg": math.exp(float(rng.uniform(math.log(0.05), math.log(0.6)))),
            "object.centre_of_mass_height_mm": height * float(rng.uniform(0.4, 0.95)),
            "blocks.gap_mm": min(250.0, size_x + 2.0 * self.clearance_mm / 2.5 * float(rng.uniform(1.5, 3.0))),
            "blocks.friction": draw(0.15, 0.35, 0.1),
            "gel.friction": draw(0.65, 0.95, 0.15),
            "gel.shear_modulus_n_per_mm2": 0.1 * math.exp(draw(-0.2, 0.2, 0.15)),
            "gel.crown_mm": draw(0.06, 0.18, 0.06),
            "grasp.force_n": draw(16.0, 38.0, 4.0),
            "grasp.height_mm": height,
            "camera.noise_grey": min(30.0, self.camera.noise_grey * draw(0.5, 1.5, 0.4)),
            "camera.light": draw(0.85, 1.15, 0.15),
            "gel.wear": draw(0.1, 0.4, 0.1),
            "x_range_mm": min(60.0, self.x_range_mm * scale),
        }
        body = self.object
        if body.shape == "hexagon" or (body.shape == "ellipse" and body.size_x_mm == body.size_y_mm):
            changes["object.size_y_mm"] = size_x  # what is regular or round stays so
        return self.varied(changes)


def load_scene(name_or_path: str | Path, **overrides: Any) -> Scene:
    """A scene by built-in name or TOML path. Overrides use `__` for the dot: gel__friction=0.5.

    Raises:
        SceneError: unknown name, unreadable file, unknown key, value out of range or impossible geometry.
    """
    path = Path(name_or_path)
    if str(name_or_path) in BUILT_IN:
        path = OBJECTS / f"{name_or_path}.toml"
    elif not path.is_file():
        near = difflib.get_close_matches(str(name_or_path), BUILT_IN, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise SceneError(f"no scene {str(name_or_path)!r}: expected a TOML file or one of {', '.join(BUILT_IN)}{hint}")
    try:
        data = read_toml(path)
    except (OSError, ContractError) as error:
        raise SceneError(str(error)) from error
    data.setdefault("name", path.stem)
    for key, value in overrides.items():
        _set(data, key.replace("__", "."), value)
    return _parse(data, str(path))


def _set(data: dict[str, Any], dotted: str, value: Any) -> None:
    *parents, last = dotted.split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise SceneError(f"{dotted}: {parent} has no keys below it")
    data[last] = value


def _parse(data: Mapping[str, Any], source: str) -> Scene:
    try:
        return Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(f"{source}: {describe(error, Scene)}") from error
