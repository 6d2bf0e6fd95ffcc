"""Options of a live cell, checked before anything starts."""

import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulation.scene.scene import Scene
from simulation.scene.worlds import TOP_LEVEL, load_scene, load_world

MOST_DRAWS = 10_000  # of a start that collides; a wide gap has none
LOCKSTEP_ONLY = ("camera.latency_ms", "speed_mm_s")  # as a scene calls them
_RANGES = {"x_mm": (-60.0, 60.0), "theta_deg": (-45.0, 45.0), "egm_lag_ms": (1.0, 500.0)}


class CellError(ValueError):
    """The requested cell cannot be set up."""


@dataclass(frozen=True)
class CellOptions:
    """Options of ``python -m simulation cell``."""

    object: str = "rectangle"
    """A name or a TOML file."""
    x_mm: float = 8.0
    """Position error at the start, across the gap."""
    theta_deg: float = 6.0
    """Yaw error at the start."""
    seed: int = 0
    """Seed of grasp, optics and noise."""
    out: Path = Path("runs/cell")
    """Folder for cell.json and the calibration."""
    fps: int | None = None
    """Camera rate: 30, 60 or 90; the sensor's if left out."""
    egm_lag_ms: float = 20.0
    """First-order lag of the arm behind the guide."""
    feed: bool = False
    """Put a new object into the fixture each time the arm is back there, and another box below the gap."""
    world: str | None = None
    """A world file (see docs/worlds.md); the project's own cell if left out."""
    egm_guide_port: int = 0
    """UDP port to which the robot sends and on which the guide listens; 0 picks a free one."""
    rws_port: int = 0
    """RWS over HTTP; 0 picks a free one, as for all ports below."""
    gripper_port: int = 0
    """WSG-50 over TCP."""
    gripper_udp_port: int = 0
    """WSG-50 over UDP."""
    gripper_udp_remote_port: int = 0
    """Port to which it sends answers to datagrams (the gripper's own is 1501); 0 answers to the sender."""
    camera_left_port: int = 0
    """MJPEG of the left finger."""
    camera_right_port: int = 0
    """MJPEG of the right finger."""
    admin_port: int = 0
    """Ground truth and faults over HTTP."""

    def check(self) -> None:
        """Raise CellError naming the invalid option."""
        if self.fps not in (None, 30, 60, 90):
            raise CellError(f"--fps {self.fps}: expected 30, 60 or 90")
        for name, (low, high) in _RANGES.items():
            if not low <= getattr(self, name) <= high:
                raise CellError(f"--{name.replace('_', '-')} {getattr(self, name)}: expected {low:g} to {high:g}")
        names = ("egm_guide", "rws", "gripper", "gripper_udp", "gripper_udp_remote", "camera_left", "camera_right")
        for name in (*names, "admin"):
            if not 0 <= getattr(self, f"{name}_port") <= 65535:
                raise CellError(f"--{name.replace('_', '-')}-port: expected 0 to 65535")


def warn_of_keys_without_effect(world: str | None, scene: str) -> None:
    """Name on stderr the keys of a world's and an object's file that a live cell does not play: `evaluate` does."""
    of_object = load_scene(scene)
    stated = of_object.model_fields_set | {f"camera.{key}" for key in of_object.camera.model_fields_set}
    _warn(scene, [key for key in LOCKSTEP_ONLY if key in stated])
    if world is not None:
        read = load_world(world)
        unstated = [f"world.{key}" for key in read.unstated.model_dump(exclude_defaults=True)]
        _warn(world, [key for key in LOCKSTEP_ONLY if key in read.changes] + unstated)


def _warn(path: str, keys: list[str]) -> None:
    written = {scenes: files for files, scenes in TOP_LEVEL.items()}
    if keys:
        named = ", ".join(written.get(key, key) for key in keys)
        print(f"{path}: without effect in real time: {named}; `evaluate` plays them", file=sys.stderr)


def draw_start(scene: Scene, seed: int) -> tuple[float, float]:
    """A start error within the scene's ranges that collides, if one does; every scene has its own sequence."""
    rng = np.random.default_rng([seed, zlib.crc32(scene.name.encode())])
    for _ in range(MOST_DRAWS):
        x_mm = float(rng.uniform(-scene.x_range_mm, scene.x_range_mm))
        theta_deg = float(rng.uniform(-scene.theta_range_deg, scene.theta_range_deg))
        if not scene.fits(x_mm, theta_deg):
            break
    return round(x_mm, 2), round(theta_deg, 2)
