"""One poke in MuJoCo's time: the blocks come, stop gently and wait, and the object turns in the pads."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from simulation.data.probe import QuasiStaticCell
from tests.simulation.physics.mujoco.model import START_MM, TIP_MM, Effort, model_of

HOLD_MS = 50.0  # rest before the motion: the grasp settles
DAMPING = np.array([300.0, 300.0, 300.0, 6e4, 6e4, 6e4])  # of the object, N ms/mm and N mm ms/rad: it must not ring


@dataclass(frozen=True)
class Pressed:
    """End of a poke: force of the blocks on the object, N [3], and its rotation in the hand, deg [3]."""

    force_n: np.ndarray
    turn_deg: np.ndarray


class Press:
    """MuJoCo's world in one poke of depth_mm past touchdown."""

    def __init__(self, cell: QuasiStaticCell, effort: Effort, depth_mm: float, *, apart: bool) -> None:
        self.effort, self.apart = effort, apart
        self.model = model_of(cell, effort, apart=apart)
        self.data = mujoco.MjData(self.model)
        self.object, self.blocks = self.model.body("object").id, self.model.body("blocks").id
        self.hand, self.depth_mm = cell.pose.copy(), depth_mm
        self.hand[2] = cell.scene.grasp.height_mm
        self.side = cell.nodes["side"].copy()
        self.spring = float(cell.constants["kn"][0] * cell.constants["area"][0])
        if apart:
            self._find_tips(len(cell.nodes))

    def _find_tips(self, count: int) -> None:
        model = self.model
        self.pressed = np.array([model.jnt_qposadr[model.body(f"press{i}").jntadr[0]] for i in range(count)])
        self.shear = np.array([model.body(f"shear{i}").id for i in range(count)])
        self.pushed = np.add.outer(model.body_dofadr[self.shear], np.arange(3))

    def _pinch(self) -> None:
        """Press every shear tip on the object's plate with its node's pressure, and the object back on the tip."""
        data = self.data
        pressure = np.maximum(self.spring * self.side * data.qpos[self.pressed], 0.0)
        normal = data.xmat[self.object].reshape(3, 3)[:, 1]
        force = -np.outer(self.side * pressure, normal)
        data.qfrc_applied[self.pushed] = force
        place = data.xpos[self.shear] - np.outer(self.side, normal) * TIP_MM
        data.xfrc_applied[self.object, :3] = -force.sum(axis=0)
        data.xfrc_applied[self.object, 3:] = -np.cross(place - data.xipos[self.object], force).sum(axis=0)

    def _place_blocks(self, time_ms: float) -> None:
        """Raise the blocks towards the hand; the rise ends at no speed, so that nothing drags there."""
        late = np.clip((time_ms - HOLD_MS) / self.effort.motion_ms, 0.0, 1.0)
        rise = -START_MM + (self.depth_mm + START_MM) * late * (2.0 - late)
        yaw = -self.hand[3]
        x, y, z = -self.hand[0], -self.hand[1], rise - self.hand[2]
        self.data.mocap_pos[0] = [x * math.cos(yaw) - y * math.sin(yaw), x * math.sin(yaw) + y * math.cos(yaw), z]
        self.data.mocap_quat[0] = [math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)]

    def run(self) -> Pressed:
        """Rest, move, look; the force is the mean over the last 2 % of the motion, in which it is all but over.

        Not later: where an object has come to rest at the limit of friction, MuJoCo's friction has no direction.
        """
        steps = math.ceil((self.effort.motion_ms + HOLD_MS) / self.effort.dt_ms)
        last = math.ceil(0.02 * self.effort.motion_ms / self.effort.dt_ms)
        force = np.zeros(3)
        for i in range(steps):
            self._place_blocks(i * self.effort.dt_ms)
            self.data.qfrc_applied[:6] = -DAMPING * self.data.qvel[:6]
            if self.apart:
                self._pinch()
            mujoco.mj_step(self.model, self.data)
            if i >= steps - last:
                force += self._block_force() / last
        turn = np.empty(3)
        mujoco.mju_quat2Vel(turn, self.data.xquat[self.object], 1.0)
        return Pressed(force, np.degrees(turn))

    def _block_force(self) -> np.ndarray:
        """Sum of the contact forces of the blocks on the object, hand frame."""
        total, wrench = np.zeros(3), np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            first, second = (self.model.geom_bodyid[g] for g in contact.geom)
            if self.blocks in (first, second):
                mujoco.mj_contactForce(self.model, self.data, index, wrench)
                force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second geom's body
                total += force if second == self.object else -force
        return total
