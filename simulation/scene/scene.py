"""Scene: a world with an object in it, everything about one simulated cell except motion.

`simulation.scene.worlds` reads it from files. Units are in the names. Frames: see `shapes` (object) and the work-object
frame (origin at the gap's centre at the height of the block tops, x across the gap, y along it, z up).
"""

import hashlib
import zlib
from collections.abc import Mapping
from typing import Any, Self

from pydantic import Field, ValidationError, model_validator

from service.contract import Sensor
from service.contract.refusals import describe
from simulation.scene import shapes
from simulation.scene.parts import HELD, Blocks, Camera, Effects, Figures, Gel, Grasp, HeldObject, Numerics, Part

APPROACH_MM = 5.0  # start of a descent above the block tops
BEYOND_MM = 5.0  # a full descent goes deeper than an object must be to count as inserted
GRAVITY_N_PER_KG = 9.81
TOPS_LEVEL_MM = 0.2  # as a client knows the blocks, which are level
OF_NO_CELL: dict[str, Any] = {"training": True, "order": True, "paper": True, "camera": {"sensor": {"name"}}}
"""Keys of a scene that do not affect its cell."""


class SceneError(ValueError):
    """A scene that cannot be read or cannot exist; the text names the key and its allowed values."""


class Scene(Part):
    """One simulated cell. Frozen; make variants with `varied` or `randomisation.randomised`.

    ``training``: `collect` presses this object by default. ``order``: its place in tables, which seeds follow.
    ``paper``: what the paper measured on the real robot.
    """

    name: str = Field(min_length=1)
    training: bool = False
    order: int | None = Field(default=None, ge=0)
    paper: Figures | None = None
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
        held = [name for name in HELD if getattr(self.object, name)]
        if held and self.object.held_shape is None:
            raise ValueError(f"object.{held[0]}: expected with held_shape, as a polygon is held by its own edges")
        corners = self.object.vertices_mm
        if corners and not shapes.is_convex(corners):
            expected = "corners of a convex polygon, counter-clockwise, each once and none of 180 deg"
            raise ValueError(f"object.vertices_mm: expected {expected}")
        if corners:
            shapes.rounded(corners, self.object.corner_radius_mm)
        return self

    @model_validator(mode="after")
    def _corners_can_exist(self) -> Self:
        body = self.object
        sections = (
            ("corner_radius_mm", body.shape, body.corner_radius_mm, (body.size_x_mm, body.size_y_mm)),
            ("held_corner_radius_mm", body.held_shape, body.held_corner_radius_mm, body.held_sizes_mm),
        )
        for name, shape, radius_mm, sizes_mm in sections:
            if shape == "ellipse" and radius_mm > 0.0:
                raise ValueError(f"object.{name}: an ellipse has none")
            if shape == "hexagon" and radius_mm >= (most_mm := 0.43 * sizes_mm[0]):
                raise ValueError(f"object.{name}: must be below {most_mm:g}, where a hexagon is a circle")
            if shape == "hexagon":
                shapes.held_polygon(shape, *sizes_mm, radius_mm)
        return self

    @model_validator(mode="after")
    def _frames_can_exist(self) -> Self:
        period_ms = 1000.0 / self.fps
        for name in ("exposure_ms", "readout_ms"):
            if (lasts_ms := getattr(self.camera, name)) > period_ms:
                raise ValueError(f"camera.{name}: {lasts_ms:g} is longer than a frame's {period_ms:g}")
        return self

    @model_validator(mode="after")
    def _can_exist(self) -> Self:
        body = self.object
        if self.blocks.gap_mm <= body.size_x_mm:
            raise ValueError(f"blocks.gap_mm: {self.blocks.gap_mm} must exceed object.size_x_mm {body.size_x_mm}")
        if self.blocks.insertion_depth_mm > (most_mm := self.blocks.height_mm - BEYOND_MM):
            raise ValueError(f"blocks.insertion_depth_mm: must be at most {most_mm:g}, or the table is in the way")
        if body.corner_radius_mm > 0.5 * (least := min(body.size_x_mm, body.size_y_mm)):
            raise ValueError(f"object.corner_radius_mm: must be 0 to {0.5 * least:g}, half of the smaller size")
        if body.held_corner_radius_mm > 0.5 * (body.held_size_x_mm or body.size_x_mm):
            raise ValueError("object.held_corner_radius_mm: must be at most half of the held section's width")
        if self.gel.crown_mm > 0.5 * self.gel.thickness_mm:
            raise ValueError(f"gel.crown_mm: must be 0 to {0.5 * self.gel.thickness_mm:g}, half of gel.thickness_mm")
        by_ratio = self.gel.poisson_ratio is None and self.gel.normal_ratio < 2.0
        if by_ratio and (self.gel.tier == "layer" or self.gel.margin_mm is not None):
            raise ValueError(
                "gel.normal_ratio: must be at least 2 where rubber pushes sideways (layer tier, margin_mm)"
            )
        if self.gel.tier == "layer" and self.effects.gel_coupling == "on":
            raise ValueError("effects.gel_coupling: the layer tier couples by itself; expected 'auto' or 'off'")
        if body.held_profile[1] + body.held_profile[2] < 3.0:
            name = "held_size_x_mm" if body.held_shape else "size_x_mm"
            raise ValueError(f"object.{name}: the held section must be at least 6 mm wide")
        return self

    @property
    def clearance_mm(self) -> float:
        """Free space on each side of a centred object, mm."""
        return 0.5 * (self.blocks.gap_mm - self.object.size_x_mm)

    @property
    def sensor(self) -> Sensor:
        return self.camera.sensor

    @property
    def full_depth_mm(self) -> float:
        """Depth of a descent that inserts: from the approach into the gap, and clearly beyond the required depth."""
        return APPROACH_MM + self.blocks.insertion_depth_mm + BEYOND_MM

    @property
    def neighbours_stay(self) -> bool:
        """Whether no press of this hand can move a block, by the law of friction: as an engineer would find out.

        The press is all that the gels can hold by friction, and the object's weight.
        """
        blocks = self.blocks
        press_n = 2.0 * self.gel.friction * self.grasp.force_n + GRAVITY_N_PER_KG * self.object.mass_kg
        held_n = blocks.table_friction * (press_n + GRAVITY_N_PER_KG * blocks.mass_kg)
        return not blocks.free or blocks.friction * press_n <= held_n

    @property
    def fps(self) -> float:
        return self.camera.fps or self.sensor.fps

    def identity_json(self) -> str:
        """Everything about the cell, as one line of JSON: its identity in data sets.

        What came later and is not asked for is left out, so that older cells keep their identity and their seeds.
        """
        if self.camera.used_share or self.effects.used_sensor != "auto":
            return self.model_dump_json(exclude=OF_NO_CELL)
        later = {"camera": OF_NO_CELL["camera"] | {"used_share": True}, "effects": {"used_sensor"}}
        return self.model_dump_json(exclude=OF_NO_CELL | later)

    @property
    def sha256(self) -> str:
        """SHA-256 of `identity_json`."""
        return hashlib.sha256(self.identity_json().encode()).hexdigest()

    @property
    def number(self) -> int:
        """Base of the seeds of this object's draws: its order or, without one, a number from its contents."""
        return zlib.crc32(self.identity_json().encode()) if self.order is None else self.order

    def fits(self, x_mm: float, theta_deg: float) -> bool:
        """Whether a vertical descent from this error inserts without touching (paper_facts' criterion)."""
        foot = self.object.footprint_mm
        right_mm, left_mm = (shapes.half_width_mm(side, theta_deg) for side in (foot, -foot))
        return max(right_mm + x_mm, left_mm - x_mm) <= 0.5 * self.blocks.gap_mm

    def varied(self, changes: Mapping[str, Any]) -> "Scene":
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
