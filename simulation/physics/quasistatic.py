"""The simulated bench: a hand that holds the object above the gap, moved by poses, with all its state.

Frames and signs are those of the work-object frame; angles at the interface in deg.
"""

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulation.physics import layer_pads
from simulation.physics.constants import BASE_K, scene_constants
from simulation.physics.grasp import close_fingers
from simulation.physics.inertia import INSTANT_S, coasting_of, duration_s
from simulation.physics.kernels import contact, load_step, records
from simulation.physics.kernels.linear import hand_into, rotation_into
from simulation.physics.pads import nodes_of, pad_of
from simulation.physics.readout import Readout
from simulation.physics.state import block_motion, rest_blocks, rotation_vector
from simulation.scene.effects import Active, active_effects
from simulation.scene.ground_truth import Pose, reasons_against
from simulation.scene.scene import APPROACH_MM, Scene
from simulation.scene.state import CellState, PhysicsError, Reason, TouchingError

Array = NDArray[np.float64]

LOST_MM, LOST_GRIP, MAX_HALVINGS = 12.0, 0.1, 6
PAUSE_SHARE, MOST_PAUSES = 0.25, 16  # step of a wait as a share of the relaxation time, and the most steps
EASED = 0.5, 0.02  # shares of a round by which friction limits follow where no shorter step helps


class QuasiStaticCell:
    """A scene with its state: `regrasp` puts the object back into the hand, `move_to` moves it quasi-statically."""

    def __init__(self, scene: Scene, seed: int = 0) -> None:
        self.scene = scene
        self.rng = np.random.default_rng(seed)
        self.active: Active = active_effects(scene)
        self.foot = np.ascontiguousarray(scene.object.footprint_mm)
        pad = pad_of(scene, self.active)
        self.readout = Readout(scene, pad, coupled=self.active.gel_coupling)
        self.constants = scene_constants(scene, self.active, pad)
        self.nodes = nodes_of(scene, pad)
        self.layer = layer_pads.pads_of(scene, self.active, pad, self.nodes, self.constants)
        self._creeps = self.layer is not None and self.layer.relaxes
        self.pace_mm_s = scene.speed_mm_s  # speed of the hand, where time matters
        self.coasting = coasting_of(scene) if self.active.inertia else None
        vertices = len(self.foot)
        self.base_slot = records.slot_count(vertices)
        self.record, self.trials, self.rows, self.slots = records.blank(vertices)
        self.state: Any = self.record[0]
        self.corner = np.empty((vertices, 3))
        self.pose, self.tilt_rad = np.zeros(4), 0.0
        self.direct = True
        self.reset_blocks()
        self.regrasp(0.0, 0.0)

    def reset_blocks(self) -> None:
        """Put both blocks back at the scene's positions."""
        weight_n = float(self.constants["block_weight"][0]) if self.active.free_blocks else 0.0
        rest_blocks(self.state, 0.5 * self.scene.blocks.gap_mm, weight_n / (4.0 * BASE_K))
        self.slots["force"][self.base_slot :] = 0.25 * weight_n
        self.slots["slide"][self.base_slot :] = 0.0

    def regrasp(self, x_mm: float, theta_deg: float) -> CellState:
        """Fixture: object centred in hand up to the pre-tilt spread, error (x_mm, theta_deg), approach height."""
        if not (math.isfinite(x_mm) and math.isfinite(theta_deg)):
            raise ValueError(f"regrasp: expected finite numbers, got {x_mm}, {theta_deg}")
        spread = self.scene.grasp
        tilt = np.radians(self.rng.normal(0.0, 1.0, 2) * (spread.pre_tilt_spread_deg, spread.pre_yaw_spread_deg))
        rotation_into(self.state["turn"], 0.0, tilt[0], tilt[1])
        self.state["place"][:], self.state["mode"][:] = 0.0, contact.TOP
        self.slots[: self.base_slot] = 0
        for name in ("sx", "sz", "slipped"):
            self.nodes[name] = 0.0
        self.grasp_lost, self._each = False, 1.0
        if self.coasting is not None:
            self.coasting.velocity[:] = 0.0
        self.pose, self.tilt_rad = np.array([0.0, 0.0, spread.height_mm + 10.0 * APPROACH_MM, 0.0]), 0.0
        close = partial(close_fingers, self.scene, self._work())
        if self.layer is None:
            close()
        elif not self.layer.close(close):
            text = f"scene {self.scene.name!r}: the pads do not settle while the fingers close"
            raise PhysicsError(text, "pads unsettled")
        self._advance(self.pose)
        # place the hand so that the object has the requested error
        self.pose[3] += math.radians(theta_deg - self._object_error()[1])
        self.pose[0] += x_mm - self._object_error()[0]
        self.pose[2] = APPROACH_MM + spread.height_mm
        return self.look()

    def _work(self) -> records.Workspace:
        """The kernels' memory; built on each call, so that a study may replace the nodes."""
        return records.Workspace(
            self.constants, self.record, self.trials, self.rows, self.slots, self.nodes, self.foot, self.corner
        )

    def move_to(self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float) -> CellState:
        """Move the TCP in a straight line; yaw about +z. Raises PhysicsError where no equilibrium is found."""
        target = np.array([x_mm, y_mm, z_mm, math.radians(yaw_deg)])
        if not np.all(np.isfinite(target)):
            raise ValueError(f"move_to: expected finite numbers, got {target.tolist()}")
        if self.grasp_lost:
            self.pose = target
            return self.look()
        self.nodes["slipped"] = 0.0
        start, reach = self.pose.copy(), self._free_share(target)
        if reach > 0.0:
            self.pose = start + reach * (target - start)
            if self._creeps:
                if self.coasting is not None:
                    self.coasting.velocity[:] = 0.0  # relative to the hand, which has carried it here
                self._advance(self.pose, duration_s(self.pose - start, self.pace_mm_s))
            if self.coasting is not None:
                self.coasting.ride(target[:3] - start[:3], self.pace_mm_s)
        rest = target - self.pose
        length = max(float(np.max(np.abs(rest[:3]))), 40.0 * abs(float(rest[3])))
        if reach < 1.0 and length > 0.0:
            begin, count = self.pose.copy(), max(1, math.ceil(length / self.scene.numerics.load_step_mm - 1e-9))
            for i in range(count):
                self._advance(begin + rest * ((i + 1) / count))
                if self.lost():
                    break
        self.pose = target
        return self.look()

    def tilt_to(self, tilt_deg: float) -> CellState:
        """Tilt the hand about its own y, the object with it; TouchingError where that touches a block."""
        if not math.isfinite(tilt_deg) or self._touching:
            raise TouchingError("the hand cannot tilt: expected a finite angle and an object that touches nothing")
        self.tilt_rad = math.radians(tilt_deg)
        return self.look()

    def wait(self, time_s: float) -> CellState:
        """Stand still: inertia oscillates, gels creep; nothing else changes. Raises PhysicsError as `move_to` does."""
        if self.grasp_lost or time_s <= 0.0:
            return self.look()
        ticks = self.coasting.ticks(time_s) if self.coasting is not None else []
        if self._creeps and not ticks:
            count = min(MOST_PAUSES, math.ceil(time_s / (PAUSE_SHARE * self.scene.gel.relaxation_s)))
            ticks = [time_s / count] * count
        self.nodes["slipped"][:] = 0.0 if ticks else self.nodes["slipped"]
        for dt_s in ticks:
            self._advance(self.pose, dt_s=dt_s)
        return self.look()

    @property
    def relaxes(self) -> bool:
        """Whether the gels creep, or the object coasts, while the hand stands still."""
        return self._creeps or self.coasting is not None

    def _free_share(self, target: Array) -> float:
        """Share of a move in which nothing touches, so that the held object just rides along."""
        if self._touching:
            return 0.0
        now, then = self._lowest(self.pose), self._lowest(target)
        if now > 1e-3 and then > 1e-3:
            return 1.0
        vertical = np.array_equal(self.pose[[0, 1, 3]], target[[0, 1, 3]])
        return max(0.0, (now - 0.01) / (now - then)) if vertical and now > then and now > 0.01 else 0.0

    def _lowest(self, pose: Array) -> float:
        turn, place = self._world(pose)
        bottom = np.column_stack([self.foot, np.full(len(self.foot), self.constants["bottom"][0])])
        return float((bottom @ turn[2]).min() + place[2] - max(0.0, float(self.state["block"][:, 2].max())))

    def _solve(self, target: Array, blend: float, *, arrived: bool = False) -> int:
        start = target if arrived else self.pose
        tilted = np.append(start, self.tilt_rad), np.append(target, self.tilt_rad)
        return int(load_step.advance(self._work(), *tilted, self.scene.numerics.residual_n, self.direct, blend))

    def _step(self, target: Array, dt_s: float | None, blend: float) -> int:
        if self.layer is None:
            return self._solve(target, blend)
        if dt_s is None:
            dt_s = duration_s(target - self.pose, self.pace_mm_s)
        solve, patient = partial(self._solve, target, blend), blend == load_step.EXACT
        return self.layer.advance((self.record, self.slots), solve, dt_s, patient=patient)

    def _pass(self, target: Array, dt_s: float | None, blend: float = 1.0) -> int:
        """One undivided load step; blend as in `load_step.advance`."""
        if self.coasting is None:
            return self._step(target, dt_s, blend)
        dt_s = duration_s(target - self.pose, self.pace_mm_s) if dt_s is None else dt_s
        dt_s = 0.0 if blend == load_step.EXACT and dt_s < INSTANT_S else dt_s
        world = self.constants, self.trials, self._centre(), dt_s
        return self.coasting.step(*world, partial(self._step, target, dt_s, blend))

    def _advance(self, target: Array, dt_s: float | None = None) -> None:
        """One load step, divided as necessary. Raises PhysicsError."""
        try:
            return self._divide(target, 0, dt_s, each=self._each)
        except PhysicsError:
            # the only equilibrium may be far away: leap over what no short step passes, or else crawl through it
            for blend in EASED:
                status = self._pass(target, dt_s, blend)
                if status == load_step.SETTLED:
                    return self._arrive(target, lost=False)
        try:
            self._divide(target, 0, dt_s, last=EASED[-1])
        except PhysicsError:
            self._divide(target, 0, dt_s, each=load_step.EXACT)
            self._each = load_step.EXACT  # what runs along an edge does so for many steps

    def _divide(self, target: Array, depth: int, dt_s: float | None, *, each: float = 1.0, last: float = 1.0) -> None:
        """Halve a load step until it settles; each, last: blend of every part, and of the shortest if stalled."""
        status = self._pass(target, dt_s, each)
        if status == load_step.STALLED and last < 1.0 and depth == MAX_HALVINGS:
            status = self._pass(target, dt_s, last)
        drops = status == load_step.STALLED and self._drops()
        # LOST counts in the shortest part alone: in a longer one the solver may have overshot
        if status != load_step.SETTLED and not drops and depth < MAX_HALVINGS:
            half_s = None if dt_s is None else 0.5 * dt_s
            for part in (0.5 * (self.pose + target), target):
                if not self.lost():
                    self._divide(part, depth + 1, half_s, each=each, last=last)
            return
        if status == load_step.STALLED and not drops:
            reason = self._why()
            raise PhysicsError(
                f"scene {self.scene.name!r}: no equilibrium within {self.scene.numerics.residual_n} N at TCP "
                f"{np.round(target[:3], 3).tolist()} mm: {reason}, forces off by {self.state['report'][0]:.2e} N",
                reason,
            )
        self._arrive(target, lost=status != load_step.SETTLED)

    def _arrive(self, target: Array, *, lost: bool) -> None:
        """Finish a load step at its target, solved or with the object lost."""
        self.pose = target
        if self.coasting is not None:
            self.coasting.arrive(self._centre())
        grips, far = self._grips(), bool(np.abs(self.state["place"]).max() > LOST_MM)
        if lost or far or grips.min() < LOST_GRIP * grips.max():
            self.grasp_lost = True

    def _drops(self) -> bool:
        """Whether the object's weight exceeds the friction between the pads."""
        return bool(self.constants["weight"][0] > self.constants["friction"][0] * self._grips().sum())

    def _why(self) -> Reason:
        """The reason why the last load step has no equilibrium."""
        if self.layer is not None and self.layer.unsettled:
            return "pads unsettled"
        return "friction unsettled" if self.state["report"][0] <= 1e-3 else "forces unbalanced"

    def lost(self) -> bool:
        return self.grasp_lost

    @property
    def _touching(self) -> bool:
        return bool(np.any(self.slots["force"][: self.base_slot] > 0.0))

    def _grips(self) -> Array:
        return np.asarray(self.nodes["pressure"].reshape(2, -1).sum(axis=1) * self.constants["area"][0])

    def _world(self, pose: Array | None = None) -> tuple[Array, Array]:
        """The object's turn [3, 3] and place [3] in the world; pose: of the hand, else where it is."""
        pose, hand = self.pose if pose is None else pose, np.empty((3, 3))
        hand_into(hand, pose[3], self.tilt_rad)
        return hand @ self.state["turn"], hand @ self.state["place"] + pose[:3]

    def _centre(self) -> Array:
        turn, place = self._world()
        return np.asarray(place + turn[:, 2] * float(self.constants["mass_height"][0]))

    def _bottom(self) -> tuple[Array, Array]:
        """The object's turn [3, 3] and the middle of its bottom face [3] in the world."""
        turn, place = self._world()
        return turn, place + turn[:, 2] * float(self.constants["bottom"][0])

    def _object_error(self) -> tuple[float, float]:
        turn, bottom = self._bottom()
        return float(bottom[0]), math.degrees(math.atan2(turn[1, 0], turn[0, 0]))

    def look(self) -> CellState:
        turn, bottom = self._bottom()
        pose, motion = Pose(turn, bottom, self.foot), block_motion(self.state, 0.5 * self.scene.blocks.gap_mm)
        touching = (self.nodes["pressure"] > 0.0).reshape(2, -1).sum(axis=1)
        slipped = self.nodes["slipped"].reshape(2, -1).sum(axis=1)
        return CellState(
            gel=self.readout(self._stretch(), self.nodes["pressure"]),
            slipping=self.readout.at_markers(self.nodes["slipped"]) > 0.0,
            slipping_share=slipped / np.maximum(touching, 1),
            wrench_n_nmm=self.state["wrench"].copy(),
            in_hand=np.concatenate([self.state["place"], rotation_vector(self.state["turn"])]),
            object_error=self._object_error(),
            bottom_z_mm=float(np.min(self.foot @ turn[2, :2]) + bottom[2]),
            block_motion=motion,
            in_contact=self._touching,
            shortfalls=tuple(reasons_against(pose, motion, self.scene.blocks, grasp_lost=self.grasp_lost)),
            grasp_lost=self.grasp_lost,
            residual_n=float(self.state["report"][0]),
        )

    def _stretch(self) -> Array:
        bristles = np.stack([self.nodes["sx"], self.nodes["sz"]], axis=1)
        return bristles if self.layer is None else self.layer.stretch
