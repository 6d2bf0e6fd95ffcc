"""Trials with known slip: descents of the simulated cell with the true slipping share of each pad in every frame.

A quarter of the pressed nodes slipping is slip (``scene.numerics.slip_share``), below a tenth there is none. Trials are
slips (the arm continues for a few frames), holds (the arm stops after contact but before slip) and free insertions.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulation.data.probe import ONSET_MM
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.randomisation import randomised
from simulation.scene.scene import Scene
from simulation.scene.state import PhysicsError
from simulation.scene.worlds import load_scene, object_names

Kind = Literal["slip", "hold", "free"]
Label = Literal["slip", "none", "between"]
NO_SLIP_SHARE = 0.10
REST_N, AFTER_SLIP_N, STILL_N, MAX_FRAMES = 5, 6, 8, 40
DEPTH_MM = 25.0


@dataclass(frozen=True, slots=True)
class SlipTrial:
    """One descent at the camera's rate; frame 0 is the reference.

    ``gel`` float32 [frames, 2, rows, columns, 3], ``share`` [frames]: true slipping share of the worse pad;
    ``onset_frame`` and ``slip_frame`` are -1 if they never came. From ``still_frame`` on the arm stands still.
    """

    name: str
    held_out: bool
    kind: Kind
    seed: int
    scene: Scene
    gel: NDArray[np.float32]
    share: NDArray[np.float64]
    onset_frame: int
    slip_frame: int
    still_frame: int

    @property
    def label(self) -> Label:
        """True class of the trial, by its largest slipping share."""
        if self.slip_frame >= 0:
            return "slip"
        return "none" if float(self.share.max()) < NO_SLIP_SHARE else "between"


def draw_trials(count: int, seed: int, fps: int) -> Iterator[SlipTrial]:
    """``count`` trials over all objects in turn: 5 slips, 4 holds and 1 free insertion in ten, half held out."""
    kinds: tuple[Kind, ...] = ("slip", "hold", "slip", "hold", "slip", "free", "hold", "slip", "hold", "slip")
    for index in range(count):
        name = object_names()[index % len(object_names())]
        turn = index // len(object_names())
        for attempt in range(20):
            rng = np.random.default_rng((seed, index, attempt))
            try:
                yield _trial(name, kinds[(turn + index) % 10], rng, turn % 2 == 1, seed * 100_003 + index, fps)
                break
            except PhysicsError:
                continue


def _trial(name: str, kind: Kind, rng: np.random.Generator, held_out: bool, seed: int, fps: int) -> SlipTrial:
    scene = randomised(load_scene(name), rng, held_out=held_out)
    x_mm, theta_deg = _error(scene, kind, rng)
    cell = QuasiStaticCell(scene, seed)
    cell.regrasp(x_mm, theta_deg)
    gel, share = _descend(cell, scene.speed_mm_s / fps, float(rng.random()), scene.numerics.slip_share)
    moved = np.abs(gel[..., :2] - gel[0, ..., :2]).max((1, 2, 3, 4)) > ONSET_MM
    onset = int(moved.argmax()) if moved.any() else -1
    still = len(gel)
    if kind == "hold" and onset >= 0:
        calm = np.flatnonzero((share < 0.7 * NO_SLIP_SHARE) & (np.arange(len(share)) >= onset))
        last = int(rng.integers(onset, calm[-1] + 1)) if calm.size else onset
        still = last + 1
        # The arm stands still: the quasi-static state no longer changes.
        gel = np.concatenate([gel[: last + 1], np.repeat(gel[last : last + 1], STILL_N, 0)])
        share = np.concatenate([share[: last + 1], np.zeros(STILL_N)])
    begin = max(0, onset - REST_N) if onset >= 0 else max(0, len(gel) - MAX_FRAMES)
    gel, share = gel[begin:][:MAX_FRAMES], share[begin:][:MAX_FRAMES]
    slips = share >= scene.numerics.slip_share
    return SlipTrial(
        name,
        held_out,
        kind,
        seed,
        scene,
        gel.astype(np.float32),
        share,
        onset - begin if onset >= 0 else -1,
        int(slips.argmax()) if slips.any() else -1,
        still - begin,
    )


def _error(scene: Scene, kind: Kind, rng: np.random.Generator) -> tuple[float, float]:
    """An error that fits for a free insertion, one that does not otherwise."""
    for _ in range(200):
        x, theta = rng.uniform(-1, 1) * scene.x_range_mm, rng.uniform(-1, 1) * scene.theta_range_deg
        if kind == "free":
            x, theta = 0.6 * x / scene.x_range_mm * scene.clearance_mm, 0.0
        if scene.fits(x, theta) == (kind == "free"):
            return float(x), float(theta)
    return 0.0, 0.0


def _descend(
    cell: QuasiStaticCell, step_mm: float, phase: float, slip_share: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Gel and slipping share frame by frame, until a few frames after slip, full depth or a lost grasp."""
    start = cell.pose.copy()
    first = cell.look()
    gels, shares = [first.gel] * 2, [0.0, 0.0]
    depth, after = -step_mm * (1 - phase), 0
    while depth < DEPTH_MM and after < AFTER_SLIP_N:
        depth = min(depth + step_mm, DEPTH_MM)
        state = cell.move_to(start[0], start[1], start[2] - max(depth, 0.0), math.degrees(start[3]))
        gels.append(state.gel)
        shares.append(float(state.slipping_share.max()))
        if max(shares) >= slip_share:
            after += 1
        if state.grasp_lost:
            break
    return np.stack(gels), np.array(shares)
