"""One guarded descent in lock step: one poke of the paper's cell, without sockets and faster than real time."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.scene import Scene
from simulation.scene.state import Cell, CellState

Outcome = Literal["blocked", "inserted", "grasp_lost"]
ONSET_MM = 0.02  # marker motion, about 0.3 px, that counts as motion of the object
FRAMES, DECISION_FRAMES = 30, 8  # frames kept of a descent, and those of them behind a decision


@dataclass(frozen=True, slots=True)
class Probe:
    """Result of one descent. Frame indices count within the kept frames; -1 means "never".

    gel: float16 [frames, 2, rows, columns, 3] = du mm, dv mm (finger frame), pressure N/mm2. depth_mm [frames]: the
    approach's z minus z. slipping: bool [frames, 2, rows, columns], where the gel slid on the object at each marker.
    wrench: [frames, 6] N, N mm on the object at the TCP, hand frame. in_hand: [frames, 6] mm, rad. error_before: (x mm,
    theta deg) of the object when the descent began.
    """

    gel: NDArray[np.float16]
    slipping: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]
    wrench: NDArray[np.float64]
    in_hand: NDArray[np.float64]
    onset_frame: int
    true_slip_frame: int
    stop_frame: int
    outcome: Outcome
    x_mm: float
    theta_deg: float
    error_before: tuple[float, float]
    block_motion: NDArray[np.float64]


class _Recorder:
    """Collects frames and finds the onset: the first frame whose markers moved by ONSET_MM since nothing touched.

    In a gel that relaxes they also creep while the object hangs free: that is no motion of the object.
    """

    def __init__(self, first: CellState) -> None:
        self.states = [first]
        self._free = first
        self.depth_mm = [0.0]
        self.onset = -1

    def add(self, state: CellState, depth_mm: float) -> int:
        index = len(self.states)
        self.states.append(state)
        self.depth_mm.append(depth_mm)
        if not state.in_contact:
            self._free = state
        elif self.onset < 0:
            moved = np.abs(state.gel[..., :2] - self._free.gel[..., :2])
            if float(moved.max()) > ONSET_MM:
                self.onset = index
        return index


def run_probe(
    scene: Scene | QuasiStaticCell,
    x_mm: float,
    theta_deg: float,
    *,
    seed: int = 0,
) -> Probe:
    """Regrasp at the given error, descend until slip, a full insertion or the force limit, and keep the last frames.

    Given a Cell instead of a Scene, its compiled state is reused: the blocks are put back and the object is regrasped,
    as with a new cell; only the draw of the grasp's pre-tilt continues the cell's random stream. For pokes that leave
    blocks and object in place, use `descend`. Raises PhysicsError where no equilibrium is found.
    """
    cell = scene if isinstance(scene, QuasiStaticCell) else QuasiStaticCell(scene, seed)
    if isinstance(scene, QuasiStaticCell):
        cell.reset_blocks()
    cell.regrasp(x_mm, theta_deg)
    return descend(cell, x_mm, theta_deg, phase=float(np.random.default_rng((seed, 1)).random()))


def descend(
    cell: Cell,
    x_mm: float,
    theta_deg: float,
    *,
    phase: float,
    fps: float | None = None,
    stop_delay_frames: int = 0,
    overtravel_mm: float = 0.0,
    press_mm: float | None = None,
) -> Probe:
    """As `run_probe`, from the cell's present state: for pokes that follow one another without a new fixture.

    phase: position of the first frame within a frame period, 0..1. The stop takes effect stop_delay_frames after the
    frame that shows slip, plus overtravel_mm. Frames are then taken at standstill until the decision's 8 frames from
    the onset are complete. press_mm: instead of stopping on slip, stop this far below the depth of the onset's frame,
    or at the force limit.
    """
    rate, speed = fps or cell.scene.fps, cell.scene.speed_mm_s
    cell.pace_mm_s = speed
    coasting = cell.coasting if isinstance(cell, QuasiStaticCell) else None
    if coasting is not None:
        coasting.speed_mm_s = speed
    record = _Recorder(cell.look())
    late_mm = stop_delay_frames * speed / rate + overtravel_mm
    slip, outcome = _lower(cell, record, speed / rate, phase, late_mm, press_mm)
    stop = len(record.states) - 1
    while record.onset >= 0 and len(record.states) <= record.onset + DECISION_FRAMES and outcome != "inserted":
        record.add(cell.wait(1.0 / rate) if cell.relaxes else record.states[-1], record.depth_mm[-1])
    return _keep(record, slip, stop, outcome, x_mm, theta_deg)


def _lower(
    cell: Cell,
    record: _Recorder,
    pitch_mm: float,
    phase: float,
    late_mm: float,
    press_mm: float | None,
) -> tuple[int, Outcome]:
    """Descend by pitch_mm per frame until something ends it; returns the slipping frame (-1: none) and the end."""
    start, limits, full_mm = cell.pose.copy(), cell.scene.numerics, cell.scene.full_depth_mm
    slip, stop_depth = -1, math.inf
    depth = -pitch_mm * (1.0 - phase)
    while True:
        depth = min(depth + pitch_mm, full_mm, stop_depth)
        state = cell.move_to(start[0], start[1], start[2] - max(depth, 0.0), math.degrees(start[3]))
        index = record.add(state, max(depth, 0.0))
        if state.grasp_lost:
            return slip, "grasp_lost"
        slips = float(state.slipping_share.max()) >= limits.slip_share
        overloaded = state.wrench_n_nmm[2] > cell.scene.grasp.force_limit_n
        if press_mm is not None and index == record.onset:
            stop_depth = min(full_mm, depth + press_mm)
        if slip < 0 and (slips or overloaded):
            slip = index
            if press_mm is None:
                stop_depth = min(full_mm, depth + late_mm)
        if press_mm is not None and overloaded:
            stop_depth = depth
        if depth >= full_mm:
            return slip, "inserted" if state.inserted else "blocked"
        if depth >= stop_depth:
            return slip, "blocked"


def _keep(record: _Recorder, slip: int, stop: int, outcome: Outcome, x_mm: float, theta_deg: float) -> Probe:
    last = len(record.states)
    if record.onset >= 0 and outcome == "inserted":
        last = min(last, record.onset + FRAMES - 4)
    index = np.maximum(np.arange(last - FRAMES, last), 0)
    shift = FRAMES - last
    states = [record.states[i] for i in index]

    def place(frame: int) -> int:
        return frame + shift if frame >= 0 and 0 <= frame + shift < FRAMES else -1

    return Probe(
        gel=np.stack([state.gel for state in states]).astype(np.float16),
        slipping=np.stack([state.slipping for state in states]),
        depth_mm=np.array([record.depth_mm[i] for i in index]),
        wrench=np.stack([state.wrench_n_nmm for state in states]),
        in_hand=np.stack([state.in_hand for state in states]),
        onset_frame=place(record.onset),
        true_slip_frame=place(slip),
        stop_frame=place(stop),
        outcome=outcome,
        x_mm=x_mm,
        theta_deg=theta_deg,
        error_before=record.states[0].object_error,
        block_motion=record.states[-1].block_motion,
    )
