"""Reads objects and worlds from TOML; a scene is a world with an object in it.

An object file has an `[object]` table and, where they matter, `[blocks]`, `[start]` and any other table of a scene. A
world file states everything about the cell except the object, and takes precedence. The folder `simulation/objects` is
the registry of named objects.
"""

import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError

from service.contract import ContractError
from service.contract.refusals import describe, nearest, reason
from service.contract.toml import read_toml
from simulation.scene.parts import Blocks, Camera, Gel, Grasp, HeldObject, Part
from simulation.scene.scene import Scene, SceneError, parsed, put
from simulation.scene.unstated import Unstated

OBJECTS = Path(__file__).parents[1] / "objects"
GAP_BEYOND_OBJECT_MM = 4.0
AS_STATED_MM = 0.5  # a size may be stated beside a polygon's corners, in rounded figures
START_SHARE, START_MOST_MM = 0.3, 15.0  # share of the object's width, and upper limit


class Start(Part):
    """Largest start errors."""

    x_range_mm: float = Field(default=15.0, gt=0.0, le=60.0)
    theta_range_deg: float = Field(default=15.0, gt=0.0, le=45.0)


class Motion(Part):
    """How the arm moves."""

    descent_speed_mm_s: float = Field(default=10.0, ge=0.5, le=200.0)


WORLD_TABLES: Mapping[str, type[Part]] = {
    "gel": Gel,
    "grasp": Grasp,
    "blocks": Blocks,
    "camera": Camera,
    "motion": Motion,
    "world": Unstated,
}
TOP_LEVEL = {"motion.descent_speed_mm_s": "speed_mm_s"}


@dataclass(frozen=True, slots=True)
class World:
    """A cell without its object: dotted keys of a scene with their values, and what the software does not know."""

    name: str = "as_trained"
    changes: Mapping[str, Any] = field(default_factory=dict)
    unstated: Unstated = field(default_factory=Unstated)

    @property
    def number(self) -> int:
        """A number from its name, for the seeds of what is drawn in it."""
        return zlib.crc32(self.name.encode())

    def around(self, scene: Scene) -> Scene:
        """The object's scene in this world. Raises SceneError where the two do not fit."""
        try:
            joined = scene.varied(self.changes)
        except SceneError as error:
            raise SceneError(f"world {self.name}, object {error}") from error
        for key, value, least in (
            ("told_gap_error_mm", joined.blocks.gap_mm + self.unstated.told_gap_error_mm, 5.0),
            ("told_height_error_mm", joined.grasp.height_mm + self.unstated.told_height_error_mm, 1.0),
        ):
            if value < least:
                raise SceneError(
                    f"world {self.name}, object {scene.name}: world.{key}: leaves {value:g} mm; at least {least:g}"
                )
        return joined


def load_world(path: str | Path) -> World:
    """A world by TOML path.

    Raises:
        SceneError: unreadable file, an unknown key, or a value out of range.
    """
    path = Path(path)
    return world_of(_read(path), path)


def world_of(tables: Mapping[str, Any], path: Path) -> World:
    """The world that the tables of a file describe. Raises SceneError as `load_world` does."""
    changes: dict[str, Any] = {}
    unstated = Unstated()
    for table, values in tables.items():
        model = WORLD_TABLES.get(table)
        if model is None:
            raise SceneError(f"{path}: {table}: unknown table{nearest(table, WORLD_TABLES)}")
        if not isinstance(values, dict):
            raise SceneError(f"{path}: {table}: expected a table of keys (given: {values!r})")
        part = _checked(path, table, model, values)
        if isinstance(part, Unstated):
            unstated = part
            continue
        plain = part.model_dump(mode="json", include=set(values))
        changes |= {TOP_LEVEL.get(f"{table}.{key}", f"{table}.{key}"): plain[key] for key in values}
    return World(path.stem, changes, unstated)


def _checked(path: Path, table: str, model: type[Part], values: Mapping[str, Any]) -> Part:
    if model is Blocks:
        if "gap_mm" in values:
            raise SceneError(f"{path}: blocks.gap_mm: the gap stands in the object's file, not in the world's")
        values = {"gap_mm": 100.0, **values}
    return _validated(path, table, model, values)


def _validated(path: Path, table: str, model: type[Part], values: Mapping[str, Any]) -> Part:
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise SceneError(f"{path}: {describe(error, model, table)}") from error


def load_scene(name_or_path: str | Path, **overrides: Any) -> Scene:
    """The scene of an object by its name in the registry or by TOML path, in the training world.

    Overrides use `__` for the dot: gel__friction=0.5.

    Raises:
        SceneError: unknown name, unreadable file, unknown key, value out of range or impossible geometry.
    """
    path = Path(name_or_path)
    if str(name_or_path) in object_names():
        path = OBJECTS / f"{name_or_path}.toml"
    elif not path.is_file():
        hint = nearest(str(name_or_path), object_names())
        raise SceneError(f"no object {str(name_or_path)!r}: expected a TOML file or the name of an object{hint}")
    data = _read(path)
    if "world" in data:
        raise SceneError(f"{path}: world: this table stands in a world's file, not in the object's")
    data.setdefault("name", path.stem)
    for key, value in overrides.items():
        put(data, key.replace("__", "."), value)
    if "start" in data:
        start = _validated(path, "start", Start, data.pop("start"))
        data |= start.model_dump(include=start.model_fields_set)
    if "motion" in data:
        motion = _validated(path, "motion", Motion, data.pop("motion"))
        data |= {TOP_LEVEL[f"motion.{key}"]: getattr(motion, key) for key in motion.model_fields_set}
    fill(data)
    scene = parsed(data, str(path))
    _same_size(scene.object, data["object"], path)
    return scene


def _same_size(body: HeldObject, given: Mapping[str, Any], path: Path) -> None:
    """Refuse sizes that a polygon's corners contradict: one of the two is a mistake."""
    for key, spans_mm in (("size_x_mm", body.size_x_mm), ("size_y_mm", body.size_y_mm)):
        stated = given.get(key, spans_mm)
        if not (isinstance(stated, int | float) and abs(stated - spans_mm) <= AS_STATED_MM):
            raise SceneError(
                f"{path}: object.{key}: vertices_mm span {spans_mm:g}; expected no other size (given: {stated!r})"
            )


def freed(scene: Scene) -> Scene:
    """An object's scene with free blocks, as an insertion meets them, unless the object's file fixes them."""
    return scene if "free" in scene.blocks.model_fields_set else scene.varied({"blocks.free": True})


def fill(data: dict[str, Any]) -> None:
    """Fill in gap and range of start errors where the object's file omits them."""
    try:
        width_mm = HeldObject.model_validate(_table(data, "object")).size_x_mm
    except ValidationError:
        return  # the scene's validation names the error
    if isinstance(data.setdefault("blocks", {}), dict):
        data["blocks"].setdefault("gap_mm", width_mm + GAP_BEYOND_OBJECT_MM)
    data.setdefault("x_range_mm", min(START_MOST_MM, START_SHARE * width_mm))


def _table(data: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    table = data.get(name)
    return table if isinstance(table, dict) else {}


def _read(path: Path) -> dict[str, Any]:
    try:
        return read_toml(path)
    except (OSError, ContractError) as error:
        raise SceneError(reason(error)) from error


@cache
def object_names() -> tuple[str, ...]:
    """The registry's objects in their order; those without one come last, by name."""

    def place(path: Path) -> tuple[float, str]:
        return float(_read(path).get("order", "inf")), path.stem

    return tuple(path.stem for path in sorted(OBJECTS.glob("*.toml"), key=place))


@cache
def training_objects() -> tuple[str, ...]:
    """The registry's objects that `collect` presses by default, in their order."""
    return tuple(name for name in object_names() if load_scene(name).training)


def files_in(given: Iterable[str | Path], known: Iterable[str] = ()) -> tuple[str, ...]:
    """Known names and files unchanged, and each folder's TOML files, except hidden ones.

    Raises:
        SceneError: an empty folder, or two of the same name: results are listed by name.
    """
    known = set(known)
    listed: list[str] = []
    for one in map(str, given):
        inside = sorted(map(str, Path(one).glob("[!.]*.toml"))) if one not in known and Path(one).is_dir() else [one]
        if not inside:
            raise SceneError(f"{one}: no TOML file in this folder")
        listed += inside
    twice = [name for name, count in Counter(Path(one).stem for one in listed).items() if count > 1]
    if twice:
        raise SceneError(f"{', '.join(twice)}: given more than once; results are listed by name")
    return tuple(listed)


def load_objects(given: Iterable[str | Path]) -> dict[str, Scene]:
    """The scenes of objects by their given names: names, files and folders. Raises SceneError."""
    return {one: load_scene(one) for one in files_in(given, object_names())}
