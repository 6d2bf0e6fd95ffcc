"""The physics behind the devices, in real time: the cameras' clock, the object in the hand, the ground truth.

At each camera tick the world reads the arm's pose, advances the mechanics to it and hands both fingers' gel states to
their cameras. Ticks that the machine could not serve are skipped and counted, and never made up for.
"""

import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import Sensor
from simulation.cell.emulators.abb.motion import Pose
from simulation.physics.inertia import duration_s
from simulation.scene.ground_truth import moved_mm
from simulation.scene.state import Cell, CellState

Gel = NDArray[np.floating[Any]]
LEAST_PACE_MM_S = 1e-3
LEAST_TILT_DEG = 0.005  # the arm's own inaccuracy


@dataclass(frozen=True, slots=True)
class Exposure:
    """One camera tick: both fingers' gel states now and one frame earlier."""

    seq: int
    captured_ns: int
    gel: Gel
    previous: Gel


@dataclass(slots=True)
class Course:
    """Extremes since the start, for the report."""

    max_block_shift_mm: float = 0.0
    max_block_tilt_deg: float = 0.0
    max_force_n: float = 0.0


class World:
    """Owns the mechanics and the camera clock; all its work runs on its own thread."""

    def __init__(
        self,
        mechanics: Cell,
        regrasp: Callable[[float, int], Pose],
        pose: Callable[[], Pose],
        *,
        sensor: Sensor,
        fps: float,
        held: bool = True,
    ) -> None:
        self.fps = fps
        self.course = Course()
        self.state: CellState | None = None
        self.error: BaseException | None = None
        self.held = held
        self.lost = False  # what was grasped last has slipped out of the hand
        self.on_unsolved: Callable[[str], None] = lambda _why: None
        self._mechanics = mechanics
        self._regrasp = regrasp
        self._pose = pose
        self._sinks: list[Callable[[Exposure], None]] = []
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="world", daemon=True)
        self._last: tuple[float, float, float, float] | None = None
        self._last_ns = 0
        self._offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
        self.part_n = 0
        self._gel: Gel = np.zeros((2, sensor.marker_rows, sensor.marker_columns, 3), np.float32)

    def on_exposure(self, sink: Callable[[Exposure], None]) -> None:
        """Have ``sink`` called with every exposure, on the world's thread."""
        self._sinks.append(sink)

    def warm(self) -> None:
        """Solve once before the clock starts, so that compilation is over when the cell says it is ready."""
        self._advance(self._pose())

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    # ---- gripper actions --------------------------------------------------------------------------------------

    def grip(self, force_n: float, *, fed: bool = False) -> None:
        """Close the fingers on the object with this force (carried out at the next tick).

        A fed object is a new one each time, off by a fixture error that the software does not know. Fingers that close
        again on what they hold leave it as it has turned between them.
        """

        def do() -> None:
            if self.held:
                return
            at = self._regrasp(force_n, self.part_n)
            self._last = None
            self.held = True
            if fed:
                here = self._pose()
                x_mm, y_mm = (a - b for a, b in zip(at.position_mm[:2], here.position_mm[:2], strict=True))
                self._offset = (x_mm, y_mm, at.yaw_deg - here.yaw_deg)
            self.part_n += 1

        self.lost = False  # at once: the gripper looks again before the next tick
        self._todo.put(do)

    def let_go(self, *, put_back: bool = False) -> None:
        """Open the fingers: the gels are unloaded and the object stays in place; ``put_back``: to be grasped again."""

        def do() -> None:
            if self.held and put_back:
                self.part_n -= 1
            self.held = False

        self._todo.put(do)

    # ---- time -------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as error:  # reported by the cell's main, which ends
            self.error = error

    def _loop(self) -> None:
        period_s = 1.0 / self.fps
        due_s = time.monotonic()
        seq = 0
        while not self._stop.wait(max(0.0, due_s - time.monotonic())):
            while not self._todo.empty():
                self._todo.get()()
            captured_ns = time.monotonic_ns()
            before = self._gel
            self._advance(self._pose())
            self._note()
            for sink in self._sinks:
                sink(Exposure(seq, captured_ns, self._gel, before))
            now_s = time.monotonic()
            seq += 1
            due_s += period_s
            if now_s > due_s:
                skipped = int((now_s - due_s) / period_s)
                seq += skipped
                due_s += skipped * period_s

    def _advance(self, pose: Pose) -> None:
        now_ns = time.monotonic_ns()
        passed_s, self._last_ns = (now_ns - self._last_ns) * 1e-9, now_ns
        if not self.held:
            self._gel = np.zeros_like(self._gel)
            return
        self._tilt(pose.lean_deg)
        x_mm, y_mm, z_mm = pose.position_mm
        where = (x_mm + self._offset[0], y_mm + self._offset[1], z_mm, pose.yaw_deg + self._offset[2])
        try:
            state = self._moved(where, passed_s)
        except RuntimeError as error:  # no equilibrium: the arm was driven into the blocks
            self.on_unsolved(str(error))
            return
        if state is not None:
            self.state, self._gel = state, np.array(state.gel, np.float32)
            self.lost = bool(state.grasp_lost)
            self.held = not self.lost

    def _tilt(self, tilt_deg: float) -> None:
        """Tilt the hand with the arm; in contact it keeps its tilt, since the client straightens in the air only."""
        change_deg = tilt_deg - math.degrees(self._mechanics.tilt_rad)
        if abs(change_deg) > LEAST_TILT_DEG and not self._mechanics.look().in_contact:
            self.state = self._mechanics.tilt_to(tilt_deg)

    def _moved(self, where: tuple[float, float, float, float], passed_s: float) -> CellState | None:
        """The state after the hand has moved there, or stood there, for a time; None if nothing changes."""
        last = self._last
        if last is not None and all(abs(a - b) < 1e-5 for a, b in zip(where, last, strict=True)):
            return self._mechanics.wait(passed_s) if self._mechanics.relaxes else None
        self._last = where
        if last is not None:
            way = np.subtract(where, last) * (1.0, 1.0, 1.0, math.radians(1.0))
            self._mechanics.pace_mm_s = max(duration_s(way, 1.0) / passed_s, LEAST_PACE_MM_S)
        return self._mechanics.move_to(*where)

    def _note(self) -> None:
        course, state = self.course, self.state
        if state is None:
            return
        moved = moved_mm(state.block_motion, self._mechanics.scene.blocks)
        course.max_block_shift_mm = max(course.max_block_shift_mm, moved)
        course.max_block_tilt_deg = max(course.max_block_tilt_deg, float(state.block_motion[:, 3].max()))
        course.max_force_n = max(course.max_force_n, float(np.linalg.norm(np.asarray(state.wrench_n_nmm)[:3])))


class HeldPart:
    """The object between the fingers, as the gripper's mechanism sees it.

    Opening the fingers puts the object back into its fixture if the arm stands at ``home``. Elsewhere the object stays
    where it is, and there is nothing to grasp until the arm has put it down at home again. ``fed``: the fixture gets
    another object as soon as the arm is back there.
    """

    def __init__(
        self, world: World, size_mm: float, pose: Callable[[], Pose], home: Pose, *, fed: bool = False
    ) -> None:
        self._world = world
        self._fed = fed
        self._size_mm = size_mm
        self._pose = pose
        self._home = home
        self._there = True

    def width_mm(self) -> float | None:
        """The object's size along the fingers' axis while it is between them."""
        self._there = self._there or (self._fed and self._is_home())
        return self._size_mm if self._there else None

    def gripped(self, force_n: float) -> None:
        self._world.grip(force_n, fed=self._fed)

    def released(self) -> None:
        self._there = self._is_home()
        self._world.let_go(put_back=self._there)

    def _is_home(self) -> bool:
        at, home = self._pose(), self._home
        near = all(abs(a - b) < 2.0 for a, b in zip(at.position_mm, home.position_mm, strict=True))
        return near and abs(at.yaw_deg - home.yaw_deg) < 2.0

    def lost(self) -> bool:
        return self._world.lost
