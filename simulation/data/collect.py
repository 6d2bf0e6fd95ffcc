"""Self-supervised collection: poke with known random errors, keep the collisions, on every core, safe to kill.

As in the paper: errors uniform in x and yaw, the object put back in its fixture every 5 pokes and drifting in the hand
between them, the descent stopped by slip. Every re-fixture draws another gel, grasp, friction, noise and light; a share
of the re-fixtures comes from held-out ranges and forms the test set.

The unit of work is a shard, a function of (seed, object, shard number) only: a killed collection restarts its
unfinished shards and gets the same bits.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from service.contract import FINGERS, Sensor
from service.durable import write_durably
from simulation.data import drawn_cells
from simulation.data.dataset import encode_shard
from simulation.data.manifest import DatasetError, ShardEntry, shard_file_name
from simulation.data.probe import Probe, descend
from simulation.data.trial import Trial, split_of
from simulation.optics.appearance import Appearance
from simulation.physics.quasistatic import QuasiStaticCell
from simulation.scene.randomisation import randomised
from simulation.scene.scene import Scene
from simulation.scene.state import Cell, PhysicsError
from simulation.scene.worlds import load_scene

POKES_PER_FIXTURE = 5
GEL = 3  # of a marker: du, dv, pressure. The foreign cell also says how far its gel bulges
MAX_STOP_DELAY_FRAMES = 2
MAX_OVERTRAVEL_MM = 0.15
LIFT_MM = 0.5
LIFT_STEP_MM = 0.5  # a lift is not recorded: steps 3 times as coarse change the drift by less than 0.05 mm
_MAX_POKES_PER_TRIAL = 40  # a scene where fewer than 1 poke in 40 collides is an error, not a data set
_GROUPS_PER_SHARD = 100_000
_SHARDS_PER_OBJECT = 10_000


@dataclass(frozen=True, slots=True)
class Plan:
    """One shard to make; small and picklable, and it determines the shard completely.

    ``known``: the known parameters of the cell, as the tables of a world file; all others are drawn.
    """

    folder: Path
    scene_name: str
    shard: int
    trials: int
    seed: int
    held_out_share: float
    sensor: Sensor | None = None
    known: Mapping[str, Mapping[str, Any]] | None = None

    @property
    def file_name(self) -> str:
        return shard_file_name(self.scene_name, self.shard)

    def group_id(self, number: int) -> int:
        """A number unique to this re-fixture in the collection, wherever the scene's TOML file lies."""
        object_id = int(hashlib.sha256(Path(self.scene_name).stem.encode()).hexdigest()[:6], 16)
        return (object_id * _SHARDS_PER_OBJECT + self.shard) * _GROUPS_PER_SHARD + number


@dataclass(frozen=True, slots=True)
class Fixture:
    """One re-fixture: the drawn cell, its appearance, its side of the split."""

    scene: Scene
    group: int
    held_out: bool
    appearances: tuple[Appearance, Appearance]
    cell_seed: int
    drawn: str = ""


def scene_of(name: str, sensor: Sensor | None) -> Scene:
    """The scene to collect from, with its sensor replaced if one is given."""
    if name in drawn_cells.KNOWN:
        return drawn_cells.base(name)
    return load_scene(name, **({"camera__sensor": sensor} if sensor else {}))


def draw_fixture(base: Scene, plan: Plan, number: int) -> tuple[Fixture, np.random.Generator]:
    """Re-fixture ``number`` of a shard and the random stream of its pokes."""
    group = plan.group_id(number)
    rng = np.random.Generator(np.random.PCG64([plan.seed, group]))
    held_out = bool(rng.random() < plan.held_out_share)
    drawn = ""
    if plan.known is not None:
        scene, drawn = drawn_cells.draw_cell(rng, plan.known, base)
    elif plan.scene_name in drawn_cells.KNOWN:
        scene, drawn = drawn_cells.draw_cell(rng, drawn_cells.KNOWN[plan.scene_name])
    else:
        scene = randomised(base, rng, held_out=held_out)
    look_seed, cell_seed = (int(n) for n in rng.integers(2**31, size=2))
    left, right = (Appearance.draw(scene, finger, look_seed) for finger in FINGERS)
    return Fixture(scene, group, held_out, (left, right), cell_seed, drawn), rng


def pokes(plan: Plan, base: Scene) -> Iterator[tuple[Fixture, int, int, Probe | None]]:
    """All pokes of a shard in order, without end: (fixture, poke in group, seed, probe or None without equilibrium).

    A group ends early when the object has left the hand or entered the gap, or no equilibrium is found as it is lifted.
    """
    for number in range(_GROUPS_PER_SHARD):
        fixture, rng = draw_fixture(base, plan, number)
        hand: Hand | None = None
        for poke in range(POKES_PER_FIXTURE):
            scene = fixture.scene
            x_mm = float(rng.uniform(-scene.x_range_mm, scene.x_range_mm))
            theta_deg = float(rng.uniform(-scene.theta_range_deg, scene.theta_range_deg))
            seed = int(rng.integers(2**31))
            try:
                hand = hand or Hand(fixture, drawn_cells.mechanics(plan.scene_name))
                hand.aim(x_mm, theta_deg)
                probe = hand.press(rng) if fixture.drawn else hand.poke(rng)
            except PhysicsError:
                yield fixture, poke, seed, None
                break
            yield fixture, poke, seed, probe
            if probe.outcome != "blocked" or not hand.lifted():
                break


class Hand:
    """A cell between two fixtures: pokes follow one another and the object keeps its drift in the hand."""

    def __init__(self, fixture: Fixture, mechanics: Callable[[Scene, int], Cell] = QuasiStaticCell) -> None:
        self._cell = mechanics(fixture.scene, fixture.cell_seed)
        self._cell.regrasp(0.0, 0.0)
        self._zero = self._cell.pose.copy()  # TCP x, y, z (mm) and yaw (rad) of a newly fixtured object at zero error
        self._top_z_mm = float(self._zero[2])

    def aim(self, x_mm: float, theta_deg: float) -> None:
        """Move over the gap to where a newly fixtured object would have this error; the held one has drifted."""
        x, y, z, yaw = (float(value) for value in self._zero)
        self._cell.move_to(x + x_mm, y, z, math.degrees(yaw) + theta_deg)

    def poke(self, rng: np.random.Generator) -> Probe:
        """Descend until slip, with a real arm's overtravel."""
        cell = self._cell
        delay_frames = int(rng.integers(MAX_STOP_DELAY_FRAMES + 1))
        overtravel_mm = float(rng.uniform(0, MAX_OVERTRAVEL_MM))
        x, _, self._top_z_mm, yaw = (float(value) for value in cell.pose)
        phase = float(rng.random())
        return descend(
            cell, x, math.degrees(yaw), phase=phase, stop_delay_frames=delay_frames, overtravel_mm=overtravel_mm
        )

    def press(self, rng: np.random.Generator) -> Probe:
        """Descend to a fixed depth below the onset, in steps of depth."""
        cell = self._cell
        x, _, self._top_z_mm, yaw = (float(value) for value in cell.pose)
        rate = cell.scene.speed_mm_s / drawn_cells.FRAME_MM
        theta_deg, press_mm = math.degrees(yaw), drawn_cells.PRESS_MM
        return descend(cell, x, theta_deg, phase=float(rng.random()), fps=rate, press_mm=press_mm)

    def lifted(self) -> bool:
        """Lift straight up until nothing touches, then to approach height; False where no equilibrium is found."""
        cell, scene, top_z_mm = self._cell, self._cell.scene, self._top_z_mm
        x, y, _, yaw = (float(value) for value in cell.pose)
        cell.scene = scene.varied({"numerics.load_step_mm": max(LIFT_STEP_MM, scene.numerics.load_step_mm)})
        try:
            while cell.look().in_contact and cell.pose[2] < top_z_mm:
                cell.move_to(x, y, min(top_z_mm, float(cell.pose[2]) + LIFT_MM), math.degrees(yaw))
            cell.scene = scene
            cell.move_to(x, y, top_z_mm, math.degrees(yaw))
        except PhysicsError:
            return False
        return True


def trial_of(fixture: Fixture, poke: int, seed: int, probe: Probe, object_name: str) -> Trial:
    """The logged trial of a poke."""
    x_mm, theta_deg = probe.error_before
    return Trial(
        x_mm=float(x_mm),
        theta_deg=float(theta_deg),
        object_name=object_name,
        gap_width_mm=fixture.scene.blocks.gap_mm,
        grasp_height_mm=fixture.scene.grasp.height_mm,
        group=fixture.group,
        poke=poke,
        seed=seed,
        scene_sha256=fixture.scene.sha256,
        onset_frame=probe.onset_frame,
        true_slip_frame=probe.true_slip_frame,
        stop_frame=probe.stop_frame,
        outcome=probe.outcome,
        split=split_of(fixture.group, held_out=fixture.held_out),
        appearances=fixture.appearances,
        gel=np.asarray(probe.gel[..., :GEL], np.float16),
        depth_mm=np.asarray(probe.depth_mm, np.float32),
        wrench=np.asarray(probe.wrench, np.float32),
        in_hand=np.asarray(probe.in_hand, np.float32),
        drawn=fixture.drawn,
        **(drawn_cells.stated(fixture.scene) if fixture.drawn else {}),
    )


def make_shard(plan: Plan) -> ShardEntry:
    """Poke until ``plan.trials`` collisions are kept and write them; same plan, same bytes.

    Raises DatasetError if the scene hardly ever collides.
    """
    entry, data = shard_of(plan)
    write_durably(plan.folder / plan.file_name, data)
    return entry


def shard_of(plan: Plan) -> tuple[ShardEntry, bytes]:
    """As :func:`make_shard`, but returns the bytes: for workers on other machines."""
    base = scene_of(plan.scene_name, plan.sensor)
    kept: list[Trial] = []
    outcomes: Counter[str] = Counter()
    for fixture, poke, seed, probe in pokes(plan, base):
        usable = probe is not None and probe.outcome == "blocked" and probe.onset_frame >= 0
        outcome = "no_equilibrium" if probe is None else probe.outcome
        outcomes[outcome if usable or outcome != "blocked" else "no_motion"] += 1
        if probe is not None and usable:
            kept.append(trial_of(fixture, poke, seed, probe, base.name))
        if len(kept) == plan.trials:
            break
        if outcomes.total() >= _MAX_POKES_PER_TRIAL * plan.trials:
            raise DatasetError(
                f"scene {plan.scene_name}: nothing to collect, {dict(outcomes)} in {outcomes.total()} pokes"
            )
    return encode_shard(plan.file_name, kept, dict(outcomes))
