"""The arm and the cameras of the simulated cell in lock step: time passes a frame at a time, as fast as it computes.

Nothing here decides anything. The motion is the real driver's in outline: constant speed, and a stop that takes effect
after the lag of the controller, so that overtravel is part of every attempt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from service.contract import FINGERS, FramePair, TactileFrame
from simulation.imprint import Appearance, Renderer
from simulation.rig import Cell, CellState
from simulation.scene import Scene

START_NS = 1_000_000_000


@dataclass(slots=True)
class LockstepCell:
    """Scene, hand and cameras with one clock. Poses are the TCP's, mm and deg, in the work-object frame."""

    scene: Scene
    cell: Cell
    renderers: tuple[Renderer, Renderer]
    stop_lag_s: float
    seed: int
    now_ns: int = START_NS
    frame: int = 0
    bottom_z_mm: float = math.inf
    moving: bool = False
    worst_in_hand_mm: float = 0.0
    state: CellState = field(init=False)

    def __post_init__(self) -> None:
        self.state = self.cell.look()

    @classmethod
    def build(cls, scene: Scene, x_mm: float, theta_deg: float, seed: int, stop_lag_s: float = 0.03) -> LockstepCell:
        """A cell with the object grasped at the error given, at approach height."""
        cell = Cell(scene, seed)
        cell.regrasp(x_mm, theta_deg)
        left, right = (Renderer(Appearance.draw(scene, finger, seed)) for finger in FINGERS)
        return cls(scene, cell, (left, right), stop_lag_s, seed)

    @property
    def now_s(self) -> float:
        """The clock in seconds."""
        return self.now_ns / 1e9

    @property
    def pose(self) -> tuple[float, float, float, float]:
        """TCP x, y, z in mm and yaw in deg."""
        x, y, z, yaw = self.cell.pose
        return float(x), float(y), float(z), math.degrees(float(yaw))

    def travel(self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float, duration_s: float) -> None:
        """Go there in a straight line; no frame is looked at on the way."""
        self._see(self.cell.move_to(x_mm, y_mm, z_mm, yaw_deg))
        self.now_ns += round(duration_s * 1e9)

    def descend(self, bottom_z_mm: float) -> None:
        """Begin to go down at the scene's speed; every `next_pair` shows what came of it."""
        self.bottom_z_mm, self.moving = bottom_z_mm, True

    def hold(self) -> None:
        """Order a stop: it takes effect after the controller's lag."""
        if self.moving:
            lag_mm = self.scene.speed_mm_s * self.stop_lag_s
            self.bottom_z_mm = max(self.bottom_z_mm, self.pose[2] - lag_mm)

    def next_pair(self) -> FramePair:
        """Advance one frame period and take both fingers' frames."""
        self.now_ns += round(1e9 / self.scene.camera.fps)
        if self.moving:
            x, y, z, yaw = self.pose
            target = max(self.bottom_z_mm, z - self.scene.speed_mm_s / self.scene.camera.fps)
            self.moving = target > self.bottom_z_mm
            self._see(self.cell.move_to(x, y, target, yaw))
        self.frame += 1
        left, right = (
            TactileFrame(finger, self.frame, self.now_ns, self._render(index)) for index, finger in enumerate(FINGERS)
        )
        return FramePair(left, right)

    def _render(self, index: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        return self.renderers[index].raw(self.state.gel[index], hash_seed(self.seed, self.frame, index))

    def _see(self, state: CellState) -> None:
        self.state = state
        self.worst_in_hand_mm = max(self.worst_in_hand_mm, float(np.linalg.norm(state.in_hand[:3])))


def hash_seed(*parts: int) -> int:
    """One seed out of several numbers, the same on every machine."""
    return int(np.random.SeedSequence(parts).generate_state(1)[0])
