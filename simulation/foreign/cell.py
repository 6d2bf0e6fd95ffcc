"""The foreign cell: a hand that holds the object in pads of finite elements above the gap.

It shares the scene, its frames and the ground truth with the project's own physics, but none of its code.
"""

import math

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.blocks import Bodies, Hand, hand_at
from simulation.foreign.closing import Closing
from simulation.foreign.elements import Face, Pad, face_of
from simulation.foreign.newton import Drive, Step
from simulation.foreign.pads import OPEN, SLIP, Grip, Pads
from simulation.foreign.readout import Readout
from simulation.foreign.rigid import rotation, rotation_vector
from simulation.foreign.surface import HeldSurface
from simulation.foreign.yielding import Creep
from simulation.scene.effects import Active, active_effects
from simulation.scene.ground_truth import Pose, reasons_against
from simulation.scene.scene import APPROACH_MM, Scene
from simulation.scene.state import CellState, PhysicsError, TouchingError

Array = NDArray[np.float64]

TOLERANCE_N = 1e-7
CLEAR_MM = 50.0
CLOSING_STEPS = 6
TOUCH_MM = 0.05  # how far the fingers close beyond first touch before they push
THROUGH = 0.9  # share of the thickness: beyond it small-strain theory has no meaning
DIVISIONS, FIRST = 4, 0.125  # on a reversal of the hand, a stiff contact loses its force within micrometres
FAILED_N = 12  # solves per grasp. Insertions that end need almost none; each may cost ten seconds
LOST_MM, LOST_GRIP = 12.0, 0.1
YAW_ARM_MM = 40.0  # a yaw counts as the arc at this radius
PAUSE_SHARE, MOST_PAUSES = 0.25, 16  # step of a wait as a share of the relaxation time, and the most steps
POISSON_RATIO = 0.48
ENDLESS_MM = 1e3


def pad_of(scene: Scene) -> Pad:
    """The gel pad that a scene describes; a rubber's Poisson's ratio unless stated."""
    gel, sensor = scene.gel, scene.sensor
    sizes, margins = [], []
    markers = (sensor.marker_columns - 1, sensor.marker_rows - 1)
    for axis, pressed_mm in enumerate((sensor.gel_width_mm, sensor.gel_height_mm)):
        beyond_mm = ENDLESS_MM if gel.margin_mm is None else gel.margin_mm[axis]
        whole_mm = markers[axis] * sensor.marker_pitch_mm + 2.0 * beyond_mm
        sizes.append(min(pressed_mm, whole_mm))
        margins.append(0.5 * (whole_mm - sizes[axis]))
    poisson = POISSON_RATIO if gel.poisson_ratio is None else gel.poisson_ratio
    return Pad(sizes[0], sizes[1], gel.thickness_mm, poisson, (margins[0], margins[1]))


def pads_of(scene: Scene, face: Face, active: Active) -> Pads:
    """Both gels and fingers of a scene, with as much yielding as it calls for."""
    gel, finger_n_per_mm = scene.gel, scene.grasp.finger_stiffness_n_per_mm
    pads = Pads(face, gel.shear_modulus_n_per_mm2, gel.friction, gel.crown_mm)
    if active.finger_compliance and finger_n_per_mm > 0.0:
        pads.stand_on_springs(finger_n_per_mm)
    if active.relaxation and gel.relaxation_share > 0.0:
        pads.creep = Creep(len(pads.side), gel.relaxation_share, gel.relaxation_s)
    return pads


class ForeignCell:
    """A scene with its state; the same interface as the project's own cell."""

    def __init__(self, scene: Scene, seed: int = 0, pad: Pad | None = None) -> None:
        self.scene, self.rng = scene, np.random.default_rng(seed)
        face, active = face_of(pad or pad_of(scene)), active_effects(scene)
        self.pads = pads_of(scene, face, active)
        self.held, self.readout = HeldSurface(scene.object), Readout(face, scene.sensor)
        self.bodies = Bodies(scene, active)
        self.pose, self.tilt_rad = np.zeros(4), 0.0
        self.residual_n = 0.0
        self.grasp_lost = False
        self.pace_mm_s = scene.speed_mm_s
        self._slid = np.zeros(len(self.pads.side), np.bool_)
        self._pace: tuple[Array, Array, Array] | None = None
        self.regrasp(0.0, 0.0)

    def reset_blocks(self) -> None:
        """Put both blocks back at the scene's positions."""
        self.bodies.reset()

    def regrasp(self, x_mm: float, theta_deg: float) -> CellState:
        """Fixture: object centred in hand up to the pre-tilt spread, error (x_mm, theta_deg), approach height."""
        if not (math.isfinite(x_mm) and math.isfinite(theta_deg)):
            raise ValueError(f"regrasp: expected finite numbers, got {x_mm}, {theta_deg}")
        spread = self.scene.grasp
        tilt = np.radians(self.rng.normal(0.0, 1.0, 2) * (spread.pre_tilt_spread_deg, spread.pre_yaw_spread_deg))
        self.grasp_lost, self._failed_n = False, 0
        self.pose, self.tilt_rad = np.array([0.0, 0.0, spread.height_mm + CLEAR_MM, 0.0]), 0.0
        self.bodies.forget()
        self._pace = None
        self._close(rotation(np.array([0.0, tilt[0], tilt[1]])))
        self._advance(self.pose)
        _, theta = self._object_error()
        self.pose[3] += math.radians(theta_deg - theta)
        self.bodies.hand = self._hand(self.pose)
        self.pose[0] += x_mm - self._object_error()[0]
        self.pose[2] = APPROACH_MM + spread.height_mm
        self.bodies.hand = self._hand(self.pose)
        return self.look()

    def _close(self, turn: Array) -> None:
        """Close the fingers in equal steps of force on the object, which is held still."""
        if self.pads.creep:
            self.pads.creep.let_go()
        opening = 2.0 * self.held.crest_mm + self.scene.gel.thickness_mm
        nodes = self.pads.rested(opening)
        self.grip = Grip(turn, np.zeros(3), opening, nodes @ turn, np.full(len(nodes), OPEN, np.int8))
        height, _ = self.held.at(self.pads.side, self.grip.on[:, 0])
        away = (self.pads.side * self.grip.on[:, 1] - height).reshape(2, -1).min(axis=1).max()
        self.grip.opening -= 2.0 * float(away) + TOUCH_MM
        self.grip.on = self.pads.rested(self.grip.opening) @ turn
        force_n = self.scene.grasp.force_n
        for share in (np.arange(CLOSING_STEPS) + 1.0) / CLOSING_STEPS:
            if not self._rests(Closing(self.pads.side, force_n * share)):
                raise PhysicsError(
                    f"scene {self.scene.name!r}: the pads do not settle while the fingers close", "pads unsettled"
                )
        pressed_mm = float(np.abs((self.grip.points - self.pads.rested(self.grip.opening))[:, 1]).max())
        if pressed_mm > THROUGH * self.scene.gel.thickness_mm:
            raise PhysicsError(
                f"grasp.force_n: {force_n} N presses the gel in by {pressed_mm:.2f} mm of "
                f"{self.scene.gel.thickness_mm} mm",
                "gel squeezed through",
            )
        if self.pads.creep:
            self.pads.creep.begin(self.pads.displacement(self.grip))

    def _rests(self, drive: Drive, travel: Array | None = None) -> bool:
        """Solve a load step in place; everything is restored where it does not converge.

        travel [4] of the hand: where it continues the last motion, the first guess continues, too.
        """
        step, before = Step(self.pads, self.held, drive, self.grip), self.grip.copy()
        if travel is not None and self._pace is not None:
            last, on, motion = self._pace
            share = float(travel @ last / (last @ last))
            if abs(share - 1.0) < 0.5 and np.abs(travel - share * last).max() < 1e-9:
                step.guess(share * on, share * motion)
        self._pace = None
        residual = step.solve(TOLERANCE_N)
        if not residual <= TOLERANCE_N:  # NaN means not at rest, too
            step.undo()
            return False
        self.residual_n = residual
        if travel is not None and travel.any():
            self._pace = travel.copy(), self.grip.on - before.on, self.bodies.motion_since(before, self.grip)
        return True

    def move_to(self, x_mm: float, y_mm: float, z_mm: float, yaw_deg: float) -> CellState:
        """Move the TCP in a straight line; yaw about +z. Raises PhysicsError where no equilibrium is found."""
        target = np.array([x_mm, y_mm, z_mm, math.radians(yaw_deg)])
        if not np.isfinite(target).all():
            raise ValueError(f"move_to: expected finite numbers, got {target.tolist()}")
        while not self.grasp_lost and not np.array_equal(self.pose, target):
            if not self.bodies.touching and (free := self._free_share(target)) > 0.0:
                way = target - self.pose
                self.pose = target if free >= 1.0 else self.pose + free * way
                self.bodies.hand = self._hand(self.pose)
                self._slid[:] = False
                if self.relaxes:
                    self._advance(self.pose, _length_mm(free * way) / self.pace_mm_s)
                continue
            rest = target - self.pose
            steps = max(1, math.ceil(_length_mm(rest) / self.scene.numerics.load_step_mm - 1e-9))
            self._advance(target if steps == 1 else self.pose + rest / steps)
        self.pose = target
        self.bodies.hand = self._hand(self.pose)
        return self.look()

    def tilt_to(self, tilt_deg: float) -> CellState:
        """Tilt the hand about its own y, the object with it; TouchingError where that touches a block."""
        if not math.isfinite(tilt_deg) or self.bodies.touching:
            raise TouchingError("the hand cannot tilt: expected a finite angle and an object that touches nothing")
        self.tilt_rad = math.radians(tilt_deg)
        self.bodies.hand = self._hand(self.pose)
        return self.look()

    def _hand(self, pose: Array) -> Hand:
        return hand_at(pose, self.tilt_rad)

    @property
    def relaxes(self) -> bool:
        """Whether the gels creep while the hand stands still."""
        return self.pads.creep is not None

    def wait(self, time_s: float) -> CellState:
        """Stand still: gels that relax creep, nothing else changes. Raises PhysicsError as `move_to` does."""
        if self.relaxes and time_s > 0.0:
            count = min(MOST_PAUSES, math.ceil(time_s / (PAUSE_SHARE * self.scene.gel.relaxation_s)))
            for _ in range(count):
                if not self.grasp_lost:
                    self._advance(self.pose, time_s / count)
        return self.look()

    def _free_share(self, target: Array) -> float:
        """Share of a straight move in which the object just rides along, clear of the blocks."""
        now, then = self._lowest(self._hand(self.pose)), self._lowest(self._hand(target))
        if now > 1e-3 and then > 1e-3:
            return 1.0
        upright = np.array_equal(self.pose[[0, 1, 3]], target[[0, 1, 3]])
        return (now - 0.01) / (now - then) if upright and now > then and now > 0.02 else 0.0

    def _lowest(self, hand: Hand) -> float:
        turn, place = hand.turn @ self.grip.turn, hand.place + hand.turn @ self.grip.place
        heights = self.bodies.foot @ turn[2] + place[2]
        return float(heights.min() - max(0.0, float(self.bodies.block_place[:, 2].max())))

    def _advance(self, target: Array, time_s: float | None = None, depth: int = 0) -> None:
        """One load step, or only its first part where necessary. Raises PhysicsError.

        time_s: its duration; by default that of the way at the present pace. The gel creeps before the step's motion.
        """
        if self._drops():
            self.grasp_lost, self.pose = True, target.copy()
            self.bodies.hand = self._hand(target)
            return
        beside, start = self.bodies.beside.copy(), self.grip.on.copy()
        before, after = self._hand(self.pose), self._hand(target)
        lasts_s = _length_mm(target - self.pose) / self.pace_mm_s if time_s is None else time_s
        creep, crept = self.pads.creep, None
        if creep:
            crept = creep.by
            creep.hold(self.pads.displacement(self.grip), lasts_s)
        self.bodies.begin(self.grip, before, after)
        if self._rests(self.bodies, target - self.pose):
            self._arrive(target, start)
            return
        self.bodies.beside, self.bodies.hand = beside, before
        if creep and crept is not None:
            creep.by = crept
        self._failed_n += 1
        if depth == DIVISIONS or self._failed_n > FAILED_N:
            raise PhysicsError(
                f"scene {self.scene.name!r}: no equilibrium within {TOLERANCE_N} N at TCP "
                f"{np.round(target[:3], 3).tolist()} mm",
                "forces unbalanced",
            )
        self._advance(self.pose + FIRST * (target - self.pose), FIRST * lasts_s, depth + 1)
        if not self.grasp_lost:
            self._advance(target, (1.0 - FIRST) * lasts_s, depth + 1)

    def _drops(self) -> bool:
        """Whether the object's weight exceeds the friction between the pads."""
        pressing = np.abs(self.pads.forces(self.grip)[:, 1]).sum()
        return self.bodies.weight_n > self.pads.friction * float(pressing)

    def _arrive(self, target: Array, start: Array) -> None:
        self.bodies.arrive(self.grip)
        self.pose = target.copy()
        moved = np.linalg.norm(self.grip.on - start, axis=1)
        self._slid = (self.grip.status == SLIP) & (moved > 1e-7)
        grips = np.abs(self.pads.forces(self.grip)[:, 1].reshape(2, -1).sum(axis=1))
        self.grasp_lost = bool(
            np.abs(self.grip.place).max() > LOST_MM or grips.min() < LOST_GRIP * self.scene.grasp.force_n
        )

    def _object_error(self) -> tuple[float, float]:
        turn, place = self.bodies.pose(self.grip)
        bottom = place - turn[:, 2] * self.scene.grasp.height_mm
        return float(bottom[0]), math.degrees(math.atan2(turn[1, 0], turn[0, 0]))

    def look(self) -> CellState:
        grip, scene = self.grip, self.scene
        turn, place = self.bodies.pose(grip)
        pose = Pose(turn, place - turn[:, 2] * scene.grasp.height_mm, scene.object.footprint_mm)
        motion = self.bodies.block_motion()
        terms = self.pads.evaluate(grip, self.pads.planes(self.held, grip.on), grip.on, None)
        pressure = np.maximum(terms.pressing, 0.0) / self.pads.area
        closed = (grip.status != OPEN).reshape(2, -1).sum(axis=1)
        return CellState(
            gel=self.readout(self.pads.displacement(grip), pressure),
            slipping=self.readout.nearest(self._slid),
            slipping_share=self._slid.reshape(2, -1).sum(axis=1) / np.maximum(closed, 1),
            wrench_n_nmm=np.zeros(6) if self.grasp_lost else self.bodies.wrench(grip),  # nobody balances it any more
            in_hand=np.concatenate([grip.place, rotation_vector(grip.turn)]),
            object_error=self._object_error(),
            bottom_z_mm=float(pose.outline[:, 2].min()),
            block_motion=motion,
            in_contact=self.bodies.touching,
            shortfalls=tuple(reasons_against(pose, motion, scene.blocks, grasp_lost=self.grasp_lost)),
            grasp_lost=self.grasp_lost,
            residual_n=self.residual_n,
        )


def _length_mm(way: Array) -> float:
    """Length of a motion (dx, dy, dz mm, yaw rad): its longest part."""
    return max(float(np.abs(way[:3]).max()), YAW_ARM_MM * abs(float(way[3])))
