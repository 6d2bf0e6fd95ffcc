"""The two blocks and the held object as rigid bodies: contacts, their forces, and the resulting motion.

A contact is a spring of the scene's stiffness along its normal and a softer one with Coulomb's limit across it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.contacts import Contacts, Properties, against_wall, is_beside, on_top
from simulation.foreign.newton import ARM_MM, Push
from simulation.foreign.pads import Grip
from simulation.foreign.rigid import about_z, cross_matrix, lines_of, rotation, rotation_vector
from simulation.scene.effects import Active
from simulation.scene.scene import GRAVITY_N_PER_KG, Scene

Array = NDArray[np.float64]

TANGENTIAL_SHARE = 0.5  # tangential stiffness over a contact's normal stiffness
TABLE_N_PER_MM = 2000.0  # below each corner of a free block
NEAR_MM = 1.0
OPENING, FIRST_BLOCK = 6, 7  # indices among the motions
SHARERS = 8  # a curved bottom's many corners share the stiffness of this many


class Hand(NamedTuple):
    """The TCP in the work-object frame: place [3], mm, turn [3, 3]."""

    place: Array
    turn: Array


class Bodies:
    """A drive of the object's twist in the hand (6), the fingers' opening (1) and the twists of free blocks (12).

    The gripper keeps its force, so the fingers follow yielding gels. The blocks' twists are in the work-object frame.
    """

    turns = True

    def __init__(self, scene: Scene, active: Active) -> None:
        blocks, body = scene.blocks, scene.object
        self.foot = np.column_stack([body.footprint_mm, np.full(len(body.footprint_mm), -scene.grasp.height_mm)])
        self.free, self._size = active.free_blocks, (blocks.size_x_mm, blocks.size_y_mm, blocks.height_mm)
        shared = blocks.stiffness_n_per_mm * min(1.0, SHARERS / len(self.foot))
        friction = blocks.friction if active.edge_friction else 0.0
        self._props = Properties(blocks.stiffness_n_per_mm, shared, friction)
        self._table_friction = blocks.table_friction
        self.weight_n = body.mass_kg * GRAVITY_N_PER_KG if scene.effects.gravity != "off" else 0.0
        self._centre = np.array([0.0, 0.0, body.centre_of_mass_height_mm - scene.grasp.height_mm])
        self._block_weight_n = blocks.mass_kg * GRAVITY_N_PER_KG
        self._half_gap_mm = 0.5 * blocks.gap_mm
        self.grip_n = scene.grasp.force_n
        self.count = FIRST_BLOCK + (12 if self.free else 0)
        corners = np.array([[x, y, -self._size[2]] for x in (0.0, self._size[0]) for y in (-0.5, 0.5)])
        self._base = corners * [1.0, self._size[1], 1.0]
        self._slots = 2 + 2 * len(self.foot)
        self.hand = Hand(np.zeros(3), np.eye(3))
        self.reset()

    def reset(self) -> None:
        sink = 0.25 * self._block_weight_n / TABLE_N_PER_MM if self.free else 0.0
        self.block_turn = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
        self.block_place = np.array([[self._half_gap_mm, 0.0, -sink], [-self._half_gap_mm, 0.0, -sink]])
        self.stretch = np.zeros((2 * self._slots + 8, 3))  # of each contact's friction, work-object frame, mm
        self.beside = np.zeros(2, np.bool_)
        self.touching = False
        self._start = (np.eye(3), np.zeros(3))
        self._block_start, self._old = (self.block_turn.copy(), self.block_place.copy()), self.stretch.copy()

    def forget(self) -> None:
        """Forget the contacts: the object is taken away from the blocks."""
        self.stretch[: 2 * self._slots] = 0.0
        self.beside[:], self.touching = False, False

    def memory(self) -> tuple[Array, ...]:
        """Copies of the blocks' poses."""
        return self.block_turn.copy(), self.block_place.copy()

    def recall(self, memory: tuple[Array, ...]) -> None:
        self.block_turn, self.block_place = (part.copy() for part in memory)

    def begin(self, grip: Grip, before: Hand, after: Hand) -> None:
        """Begin a step: the hand is already at its end; slips count from the bodies' poses before the step."""
        self.hand = after
        self._start = (before.turn @ grip.turn, before.place + before.turn @ grip.place)
        self._block_start = (self.block_turn.copy(), self.block_place.copy())
        self._old = self.stretch.copy()
        for b in range(2):
            self.beside[b] = is_beside(self._bottom_from(b, grip), bool(self.beside[b]))

    def arrive(self, grip: Grip) -> None:
        """End a step at rest: keep the stretch of friction."""
        contacts, _ = self._contacts(grip)
        press, drag = self._forces(contacts, self._slid(contacts, grip))
        self.stretch[:] = 0.0
        self.stretch[contacts.slots] = -drag / (TANGENTIAL_SHARE * contacts.stiffness)[:, None]
        self.touching = bool((press[contacts.slots < 2 * self._slots] > 0.0).any())

    # ---- geometry ---------------------------------------------------------------------------------------------------

    def pose(self, grip: Grip) -> tuple[Array, Array]:
        """The object's turn [3, 3] and place [3] in the work-object frame."""
        return self.hand.turn @ grip.turn, self.hand.place + self.hand.turn @ grip.place

    def _bottom_from(self, b: int, grip: Grip) -> Array:
        """The bottom's corners in block b's frame, [v, 3]."""
        turn, place = self.pose(grip)
        return np.asarray((self.foot @ turn.T + place - self.block_place[b]) @ self.block_turn[b])

    def _contacts(self, grip: Grip) -> tuple[Contacts, NDArray[np.intp]]:
        """All possible contacts now, and their bodies: 0, 1: the object and a block; 2, 3: a block and the table."""
        parts = [self._of_block(b, grip) for b in range(2)]
        bodies = [np.full(len(part.gaps), b) for b, part in enumerate(parts)]
        if self.free:
            parts += [self._on_table(b) for b in range(2)]
            bodies += [np.full(4, 2), np.full(4, 3)]
        joined: list[Any] = [np.concatenate(each) for each in zip(*parts, strict=True)]
        return Contacts(*joined), np.concatenate(bodies)

    def _of_block(self, b: int, grip: Grip) -> Contacts:
        corners, axis = self._bottom_from(b, grip), self.block_turn[b].T @ self.pose(grip)[0][:, 2]
        find = against_wall if self.beside[b] else on_top
        contacts, frame = find(corners, axis, self._props), self.block_turn[b]
        close = contacts.gaps < NEAR_MM
        if not close.all():
            near: list[Any] = [part[close] for part in contacts]
            contacts = Contacts(*near)
        return contacts._replace(
            points=contacts.points @ frame.T + self.block_place[b],
            normals=contacts.normals @ frame.T,
            slots=contacts.slots + b * self._slots,
            travel=frame @ contacts.travel @ frame.T,
        )

    def _on_table(self, b: int) -> Contacts:
        points = self._base @ self.block_turn[b].T + self.block_place[b]
        up, slots = np.tile([0.0, 0.0, 1.0], (4, 1)), 2 * self._slots + 4 * b + np.arange(4)
        stiffness, friction = np.full(4, TABLE_N_PER_MM), np.full(4, self._table_friction)
        travel, turns = np.tile(np.eye(3), (4, 1, 1)), np.zeros(4, np.bool_)
        return Contacts(points, up, points[:, 2] + self._size[2], slots, stiffness, travel, turns, friction)

    # ---- forces -----------------------------------------------------------------------------------------------------

    def _slid(self, contacts: Contacts, grip: Grip) -> Array:
        """Slide of the first body's material on the second's since the step began, [m, 3], mm, with stretch."""
        points, slots = contacts.points, contacts.slots
        turn, place = self.pose(grip)
        ours = (points - place) @ (self._start[0] @ turn.T).T + self._start[1]
        theirs = points
        if self.free:
            theirs = points.copy()
            for b in range(2):
                mine, based = slots // self._slots == b, (slots - 2 * self._slots) // 4 == b
                back = self.block_turn[b] @ self._block_start[0][b].T
                moved = (points - self.block_place[b]) @ back + self._block_start[1][b]
                theirs[mine], ours[based] = moved[mine], moved[based]
        slid, normals = theirs - ours + self._old[slots], contacts.normals
        return np.asarray(slid - (slid * normals).sum(axis=1)[:, None] * normals)

    def _forces(self, contacts: Contacts, slid: Array) -> tuple[Array, Array]:
        """Normal forces [m] and friction [m, 3] on the first bodies, N."""
        press = np.maximum(-contacts.gaps, 0.0) * contacts.stiffness
        drag = -(TANGENTIAL_SHARE * contacts.stiffness)[:, None] * slid
        size = np.sqrt((drag * drag).sum(axis=1))
        return press, drag * np.minimum(1.0, contacts.friction * press / np.maximum(size, 1e-300))[:, None]

    def _slopes(self, contacts: Contacts, press: Array, slid: Array, *, careful: bool) -> Array:
        """Derivative of each contact's force on its first body by relative motion there, [m, 3, 3]."""
        across = TANGENTIAL_SHARE * contacts.stiffness
        normals, size = contacts.normals, np.sqrt((slid * slid).sum(axis=1))
        bound, most = contacts.friction * press, np.maximum(size, 1e-300)
        slips = across * size > bound
        ahead = slid / most[:, None] * (not careful)
        flat = np.eye(3) - normals[:, :, None] * normals[:, None, :]
        stick = across[:, None, None] * flat
        slide = (bound / most)[:, None, None] * (flat - ahead[:, :, None] * ahead[:, None, :])
        down = (contacts.stiffness * (press > 0.0))[:, None, None] * normals[:, None, :]
        follow = (contacts.friction * slips)[:, None] * ahead
        return np.asarray(-(normals - follow)[:, :, None] * down - np.where(slips[:, None, None], slide, stick))

    def _follow(self, contacts: Contacts, bodies: NDArray[np.intp]) -> Array:
        """Motion of the first body's point relative to the second's per unit of all motions, [m, 3, k]."""
        out = np.zeros((len(bodies), 3, self.count))
        of_object = bodies < 2
        local = (contacts.points[of_object] - self.hand.place) @ self.hand.turn
        out[of_object, :, :6] = self.hand.turn @ lines_of(local)
        for b in range(2) if self.free else ():
            at = _of_block_motion(b)
            for body, sign in ((b, -1.0), (2 + b, 1.0)):
                mine = bodies == body
                out[mine, :, at] = sign * lines_of(contacts.points[mine] - self.block_place[b])
        return out

    # ---- the drive --------------------------------------------------------------------------------------------------

    def push(self, grip: Grip) -> Push:
        """Contacts and weights; careful: sliding contacts are as stiff along their slide as across it."""
        contacts, bodies = self._contacts(grip)
        slid = self._slid(contacts, grip)
        press, drag = self._forces(contacts, slid)
        forces, follow = press[:, None] * contacts.normals + drag, self._follow(contacts, bodies)
        flat = follow.reshape(3 * len(bodies), self.count)

        def slope(careful: bool) -> Array:
            slopes = self._slopes(contacts, press, slid, careful=careful) @ follow
            slopes[:, :, 3:6] -= (contacts.turns * press)[:, None, None] * cross_matrix(contacts.normals) @ hand
            out: Array = flat.T @ slopes.reshape(flat.shape)
            ours = bodies < 2
            arms = (cross_matrix(forces[ours]) @ contacts.travel[ours] @ follow[ours]).sum(axis=0)
            out[3:6] -= hand.T @ arms
            return out

        hand = self.hand.turn
        return Push(self._weights(grip) + flat.T @ forces.ravel(), slope)

    def _weights(self, grip: Grip) -> Array:
        out = np.zeros(self.count)
        down = -self.weight_n * self.hand.turn[2]  # in the hand, which may be tilted
        out[:3], out[3:6] = down, np.cross(grip.place + grip.turn @ self._centre, down)
        out[OPENING] = -self.grip_n
        for b in range(2) if self.free else ():
            at = FIRST_BLOCK + 6 * b
            x, y, _ = self.block_turn[b] @ (np.array([0.5, 0.0, -0.5]) * self._size)
            out[at + 2] = -self._block_weight_n
            out[at + 3], out[at + 4] = -y * self._block_weight_n, x * self._block_weight_n
        return out

    def lines(self, _grip: Grip, points: Array) -> Array:
        """Nodes follow the object's twist, and the gel's rest moves with the fingers: [n, 3, 7]."""
        opening = np.zeros((len(points), 3, 1))
        opening[:, 1, 0] = np.repeat([-0.5, 0.5], len(points) // 2)
        return np.concatenate([lines_of(points), opening], axis=2)

    def move(self, grip: Grip, motion: Array) -> None:
        """Apply twists to the object and to the blocks, and open the fingers."""
        turn = rotation(motion[3:6])
        grip.turn, grip.place = turn @ grip.turn, turn @ grip.place + motion[:3]
        grip.opening += float(motion[OPENING])
        for b in range(2) if self.free else ():
            x, y, z, *angles = motion[_of_block_motion(b)]
            self.block_turn[b] = rotation(np.array(angles)) @ self.block_turn[b]
            self.block_place[b] += (x, y, z)

    def motion_since(self, before: Grip, after: Grip) -> Array:
        """The motion [k] by which `move` goes from one state to the other; the blocks' since the step began."""
        out = np.zeros(self.count)
        turn = after.turn @ before.turn.T
        out[:3], out[3:6] = after.place - turn @ before.place, rotation_vector(turn)
        out[OPENING] = after.opening - before.opening
        for b in range(2) if self.free else ():
            turned = rotation_vector(self.block_turn[b] @ self._block_start[0][b].T)
            out[_of_block_motion(b)] = np.concatenate([self.block_place[b] - self._block_start[1][b], turned])
        return out

    def weight(self, force: Array) -> float:
        """Forces in N; torques by ARM_MM."""
        parts = np.abs(np.delete(force, OPENING).reshape(-1, 2, 3)) / np.array([1.0, ARM_MM])[:, None]
        return max(float(parts.max()), abs(float(force[OPENING])))

    def reach(self, motion: Array) -> float:
        """About how far a motion [k] moves anything, mm."""
        parts = np.abs(np.delete(motion, OPENING).reshape(-1, 2, 3)) * np.array([1.0, ARM_MM])[:, None]
        return max(float(parts.max()), abs(float(motion[OPENING])))

    def wrench(self, grip: Grip) -> Array:
        """Wrench of blocks and weight on the object, [6] N, N mm, at the TCP, hand frame."""
        return self.push(grip).force[:6]

    def block_motion(self) -> Array:
        """Motion of both blocks, [2, 4]: dx, dy mm, yaw and tilt deg."""
        out = np.zeros((2, 4))
        for b, sign in enumerate((1.0, -1.0)):
            turn = self.block_turn[b] * [sign, sign, 1.0]
            out[b, :2] = self.block_place[b, :2] - (sign * self._half_gap_mm, 0.0)
            out[b, 2] = math.degrees(math.atan2(turn[1, 0], turn[0, 0]))
            out[b, 3] = math.degrees(math.atan2(math.hypot(turn[2, 0], turn[2, 1]), turn[2, 2]))
        return out


def _of_block_motion(b: int) -> slice:
    return slice(FIRST_BLOCK + 6 * b, FIRST_BLOCK + 6 + 6 * b)


def hand_at(pose: Array, tilt_rad: float = 0.0) -> Hand:
    """The hand at a TCP pose (x, y, z mm, yaw rad), tilted about its own y."""
    return Hand(pose[:3].copy(), about_z(float(pose[3])) @ rotation(np.array([0.0, tilt_rad, 0.0])))
