"""Worlds and objects outside the training set, drawn over the range of real cells.

Worlds come from a Latin hypercube: over `count` of them every quantity is spread evenly over its range. The ranges are
those that collection draws from (`docs/worlds.md`), and they are frozen: do not change them to suit a network.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from service.contract.toml import toml_text
from simulation.scene import shapes
from simulation.scene.rubber import touched_width_mm
from simulation.scene.scene import Scene, SceneError, parsed
from simulation.scene.worlds import Start, World, fill, world_of

Tables = dict[str, dict[str, Any]]
Map = Callable[[float], Any]

REACH_PITCHES = (0.15, 3.0)  # shear reach of a fully touched pad
SPEED_MM_S = (3.0, 40.0)
BLIND_MM = 3.0  # travel of the arm before a stop takes effect, in a cell that is run with care
HELD_MM = 8.0  # an object that a soft pad touches on less cannot be held
HELD_OFF_MM = 4.0  # from the middle of a pad of 21 mm
PAD_MM2, PITCH_MM = 463.05, 1.05  # of the sensor for which worlds are drawn
MU, FORCE_N, THICKNESS_MM = (0.45, 1.0), (10.0, 40.0), (1.5, 4.0)


def _even(low: float, high: float) -> Map:
    return lambda u: round(low + (high - low) * u, 6)


def _log(low: float, high: float) -> Map:
    return lambda u: float(f"{low * (high / low) ** u:.4g}")


def _above(share: float, low: float, high: float) -> Map:
    """0 in a share of the draws; the rest log-uniform from low to high."""
    rest = _log(low, high)
    return lambda u: 0.0 if u < share else rest((u - share) / (1.0 - share))


QUANTITIES: Mapping[str, Map] = {
    "gel.tier": lambda u: "bristle" if u < 0.5 else "layer",
    "gel.poisson_ratio": _even(0.25, 0.495),
    "gel.margin_x_mm": lambda u: round(8.0 * u * u, 3),
    "gel.margin_z_mm": lambda u: round(8.0 * u * u, 3),
    "gel.crown_mm": _even(0.03, 0.25),
    "gel.wear": _even(0.0, 0.4),
    "gel.relaxation_share": _even(0.0, 0.4),
    "gel.relaxation_s": _log(0.1, 3.0),
    "grasp.height_mm": _even(25.0, 95.0),
    "grasp.finger_stiffness_n_per_mm": _above(0.25, 15.0, 300.0),
    "blocks.friction": _even(0.15, 0.45),
    "blocks.stiffness_n_per_mm": _log(200.0, 3000.0),
    "blocks.mass_kg": _log(0.3, 2.0),
    "blocks.free": lambda u: u < 0.8,
    "camera.fps": lambda u: round(10.0 * 12.0**u, 1),
    "camera.latency_ms": _even(0.0, 100.0),
    "camera.noise_grey": _even(1.0, 4.0),
    "camera.light": _even(0.85, 1.15),
    "camera.dropped_share": _above(0.5, 0.002, 0.05),
    "world.tcp_offset_x_mm": _even(-2.0, 2.0),
    "world.tcp_offset_y_mm": _even(-2.0, 2.0),
    "world.frame_yaw_deg": _even(-2.0, 2.0),
    "world.camera_scale_left": _even(0.97, 1.03),
    "world.camera_scale_right": _even(0.97, 1.03),
    "world.camera_roll_left_deg": _even(-2.0, 2.0),
    "world.camera_roll_right_deg": _even(-2.0, 2.0),
    "world.stop_lag_s": _even(0.01, 0.08),
    "world.blocks_up_mm": _even(-1.0, 1.0),
    "world.told_gap_error_mm": _even(-2.0, 2.0),
    "world.told_height_error_mm": _even(-5.0, 5.0),
}
PAIRS = {
    "gel.margin_mm": ("gel.margin_x_mm", "gel.margin_z_mm"),
    "world.tcp_offset_mm": ("world.tcp_offset_x_mm", "world.tcp_offset_y_mm"),
    "world.camera_scale": ("world.camera_scale_left", "world.camera_scale_right"),
    "world.camera_roll_deg": ("world.camera_roll_left_deg", "world.camera_roll_right_deg"),
}
MIXED = ("reach", "friction", "force", "thickness", "speed")


def draw_worlds(count: int, seed: int, within: Mapping[str, tuple[float, float]] | None = None) -> list[Tables]:
    """``count`` worlds as tables of a world file, the same for the same arguments. Raises ValueError.

    within: sub-ranges, in shares 0..1 of the full range, for quantities to restrict.
    """
    if count < 1:
        raise ValueError(f"--count {count}: expected at least 1")
    names = (*MIXED, *QUANTITIES)
    low, high = np.array([(within or {}).get(name, (0.0, 1.0)) for name in names]).T
    cube = qmc.LatinHypercube(len(names), seed=np.random.default_rng((seed, 0x3D))).random(count)
    return [_world(dict(zip(names, row, strict=True))) for row in (low + (high - low) * cube).tolist()]


def draw_world(rng: np.random.Generator) -> Tables:
    """One world, every quantity drawn independently."""
    return _world({name: float(rng.random()) for name in (*MIXED, *QUANTITIES)})


def _world(u: Mapping[str, float]) -> Tables:
    flat = {name: of(u[name]) for name, of in QUANTITIES.items()}
    for pair, parts in PAIRS.items():
        flat[pair] = [flat.pop(part) for part in parts]
    flat |= gel_of_reach(u["reach"], u["friction"], u["force"], u["thickness"])
    late_s = 1e-3 * flat["camera.latency_ms"] + flat["world.stop_lag_s"]
    top_mm_s = max(SPEED_MM_S[0], min(SPEED_MM_S[1], fastest_mm_s(flat["camera.fps"], late_s)))
    flat["motion.descent_speed_mm_s"] = _log(SPEED_MM_S[0], top_mm_s)(u["speed"])
    tables: Tables = {}
    for dotted, value in flat.items():
        table, key = dotted.split(".")
        tables.setdefault(table, {})[key] = value
    return tables


def fastest_mm_s(fps: float, late_s: float) -> float:
    """Speed of a cell: `BLIND_MM` until a stop takes effect, and within the client's motion lease.

    The lease is 1.5 mm, or 0.1 s where that is further; one and a half frames and 60 ms of it are used up.
    """
    used_s = 1.5 / fps + 0.06
    return min(BLIND_MM / (1.0 / fps + late_s), math.inf if used_s <= 0.1 else 1.5 / used_s)


def gel_of_reach(reach: float, friction: float, force: float, thickness: float) -> dict[str, float]:
    """Gel and grip from shares 0..1: the shear reach is log-uniform; friction, grip and thickness half follow it.

    The shear modulus follows: mu p t / (reach times pitch), see `rubber.shear_reach_pitches`.
    """
    pitches = REACH_PITCHES[0] * (REACH_PITCHES[1] / REACH_PITCHES[0]) ** reach
    mixed = (
        _log(*bounds)(0.5 * (reach + own))
        for bounds, own in ((MU, friction), (FORCE_N, force), (THICKNESS_MM, thickness))
    )
    mu, force_n, thickness_mm = mixed
    modulus = mu * force_n / PAD_MM2 * thickness_mm / (pitches * PITCH_MM)
    return {
        "gel.friction": mu,
        "gel.thickness_mm": thickness_mm,
        "gel.shear_modulus_n_per_mm2": float(f"{modulus:.4g}"),
        "grasp.force_n": force_n,
    }


def draw_objects(count: int, seed: int) -> list[Tables]:
    """``count`` convex objects of 30 to 130 mm as tables of an object file. Raises ValueError on a count below 1."""
    if count < 1:
        raise ValueError(f"--count {count}: expected at least 1")
    rng, drawn = np.random.default_rng((seed, 0x0B)), list[Tables]()
    while len(drawn) < count:
        drawn.append(draw_object(rng))
    return drawn


def draw_object(rng: np.random.Generator) -> Tables:
    """One object that a soft pad can hold."""
    while True:
        tables = _object(rng)
        try:
            held_mm = touched_width_mm(scene_of_tables(tables, "drawn"))
        except SceneError:
            continue  # its corners cannot be rounded as drawn
        if held_mm >= HELD_MM:
            return tables


def _object(rng: np.random.Generator) -> Tables:
    x_mm = round(float(rng.uniform(30.0, 130.0)), 1)
    y_mm = round(float(rng.uniform(30.0, 110.0)), 1)  # the gripper's largest opening
    radius_mm = round(float(rng.choice([0.0, rng.uniform(0.0, 0.25)]) * min(x_mm, y_mm)), 1)
    shape = str(rng.choice(["rectangle", "ellipse", "hexagon", "polygon"]))
    body: dict[str, Any] = {"shape": shape}
    if shape == "polygon":
        body["vertices_mm"] = _polygon(rng, x_mm, y_mm)
    else:
        body |= {"size_x_mm": x_mm, "size_y_mm": y_mm}
        if shape == "hexagon":
            body["size_y_mm"] = body["size_x_mm"] = min(x_mm, 110.0)
    if radius_mm and shape != "ellipse":
        body["corner_radius_mm"] = radius_mm
    body["mass_kg"] = round(math.exp(float(rng.uniform(math.log(0.05), math.log(0.6)))), 3)
    body["texture"] = str(rng.choice(["smooth", "paper", "ribbed", "label", "layers"]))
    return {"object": body}


def _polygon(rng: np.random.Generator, x_mm: float, y_mm: float) -> list[list[float]]:
    """Corners of a convex polygon on an ellipse of these sizes, 4 to 9 of them.

    It is oriented for a parallel gripper: least width along y, and each finger touches it near its middle.
    """
    while not _held_in_the_middle(corners := _drawn_corners(rng, x_mm, y_mm)):
        pass
    return [[round(float(x), 2), round(float(y), 2)] for x, y in corners]


def _drawn_corners(rng: np.random.Generator, x_mm: float, y_mm: float) -> NDArray[np.float64]:
    count = int(rng.integers(4, 10))
    angles = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.35, 0.35, count)) / count + rng.uniform(0.0, np.pi)
    corners = 0.5 * np.stack([x_mm * np.cos(angles), y_mm * np.sin(angles)], axis=1)
    corners *= np.array([x_mm, y_mm]) / np.ptp(corners, axis=0)
    return shapes.centred(min(_laid_on_its_edges(corners), key=lambda laid: np.ptp(laid[:, 1])))


def _laid_on_its_edges(corners: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """The polygon turned so that an edge lies along x, for each edge: its least width is across one of them."""
    for along_x, along_y in np.roll(corners, -1, axis=0) - corners:
        cosine, sine = np.array([along_x, along_y]) / np.hypot(along_x, along_y)
        yield corners @ np.array([[cosine, -sine], [sine, cosine]])


def _held_in_the_middle(corners: NDArray[np.float64]) -> bool:
    """Whether both fingers touch a polygon near their middle; elsewhere it would turn between them."""
    x_mm, y_mm = corners.T
    sides = x_mm[y_mm > y_mm.max() - 0.1], x_mm[y_mm < y_mm.min() + 0.1]
    return all(side.min() - HELD_OFF_MM < 0.0 < side.max() + HELD_OFF_MM for side in sides)


def scene_of_tables(tables: Tables, name: str) -> Scene:
    """The scene of an object file's tables, in the training world. Raises SceneError."""
    data: dict[str, Any] = {"name": name, **tables}
    if "start" in data:
        data |= Start.model_validate(data.pop("start")).model_dump(exclude_unset=True)
    fill(data)
    return parsed(data, name)


def world(tables: Tables, name: str) -> World:
    """A drawn world. Raises SceneError."""
    return world_of(tables, Path(f"{name}.toml"))


def toml(tables: Tables, comment: str) -> str:
    """A TOML file with these tables."""
    return f"# {comment}\n\n{toml_text(tables)}"
