"""The same poke in MuJoCo: every node of a pad a sprung tip, every point of a block's edge a fixed bead.

An independent check of equilibrium, friction and contact: MuJoCo integrates Newton's equations in time with its own
convex contact solver, knows nothing of load steps, return mapping or our contact geometry, and is given only the
pads' openings, stiffnesses and places. Hand frame, SI units; the blocks rise towards the resting hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from simulation.probe import Cell

TIP_KG, RISE_M_S, HOLD_S = 1e-3, 0.005, 0.05
CONTACT_S, STIFF = 1e-3, 0.9995
DAMPING = np.array([300.0, 300.0, 300.0, 0.06, 0.06, 0.06])  # of the object, N s/m and N m s/rad: it must not ring
BEAD_MM, TIP_MM, BEAD_PITCH_MM, INSET_MM, START_MM = 0.1, 0.1, 2.0, 1.0, 0.05


@dataclass(frozen=True)
class Pressed:
    """End of a poke: force of the blocks on the object, N [3], and its rotation in the hand, deg [3]."""

    force_n: np.ndarray
    turn_deg: np.ndarray


def _prism(name: str, outline: np.ndarray, low_mm: float, high_mm: float) -> str:
    points = "  ".join(f"{x / 1e3:.9g} {y / 1e3:.9g} {z / 1e3:.9g}" for z in (low_mm, high_mm) for x, y in outline)
    return f'<mesh name="{name}" vertex="{points}"/>'


def _held_outline(cell: Cell) -> np.ndarray:
    """Polygon [n, 2] in mm of the held section, fine enough for its sagitta not to count (under 0.1 um)."""
    crest, flat, rx, ry, slope = (float(value) for value in cell.constants["profile"][0])
    reach = flat + (0.4 * crest / slope if slope > 0 else 0.9 * rx)
    beyond = np.linspace(0.0, reach - flat, 2 if slope > 0 else 150)
    drop = slope * beyond if slope > 0 else ry * (1.0 - np.sqrt(1.0 - (beyond / rx) ** 2))
    right = np.column_stack([flat + beyond, crest - drop])
    return np.concatenate([right * sign for sign in ((1, 1), (-1, 1), (-1, -1), (1, -1))])


def _tips(cell: Cell) -> str:
    constants, opening = cell.constants[0], float(cell.state["opening"])
    kt, kn = (1e3 * float(constants[name] * constants["area"]) for name in ("kt", "kn"))
    parts = []
    for node in cell.nodes:
        y = node["side"] * (0.5 * opening + node["crown"]) / 1e3
        joints = "".join(
            f'<joint type="slide" axis="{axis}" stiffness="{k:.9g}" damping="{2 * np.sqrt(k * TIP_KG):.9g}"/>'
            for axis, k in (("1 0 0", kt), ("0 1 0", kn), ("0 0 1", kt))
        )
        parts.append(
            f'<body pos="{node["x"] / 1e3:.9g} {y:.9g} {node["z"] / 1e3:.9g}">{joints}'
            f'<geom type="sphere" size="{TIP_MM / 1e3}" pos="0 {node["side"] * TIP_MM / 1e3:.9g} 0" mass="{TIP_KG}" '
            f'contype="1" conaffinity="8" priority="1" friction="{cell.scene.gel.friction} 0 0" condim="3"/></body>'
        )
    return "".join(parts)


def _inside_mm(polygon: np.ndarray, point: tuple[float, float]) -> float:
    """How far inside a convex, counter-clockwise polygon a point is, mm."""
    along = np.roll(polygon, -1, axis=0) - polygon
    normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    return float(np.min(np.sum((np.array(point) - polygon) * normal, axis=1)))


def _beads(cell: Cell, x_mm: float, theta_deg: float) -> str:
    half, reach = 0.5 * cell.scene.blocks.gap_mm, 0.5 * cell.scene.object.size_y_mm + 15.0
    turn = np.radians(-theta_deg)
    friction = cell.scene.blocks.friction
    parts = []
    for side in (1.0, -1.0):
        for y in np.arange(-reach, reach, BEAD_PITCH_MM):
            gx, gy = side * half - x_mm, y
            place = (gx * np.cos(turn) - gy * np.sin(turn), gx * np.sin(turn) + gy * np.cos(turn))
            if _inside_mm(cell.foot, place) < INSET_MM:
                continue
            parts.append(
                f'<geom type="sphere" size="{BEAD_MM / 1e3}" contype="2" conaffinity="4" condim="3" priority="1" '
                f'pos="{place[0] / 1e3:.9g} {place[1] / 1e3:.9g} {-BEAD_MM / 1e3}" friction="{friction} 0 0"/>'
            )
    return "".join(parts)


def model_of(cell: Cell, x_mm: float, theta_deg: float, dt_s: float) -> mujoco.MjModel:
    """The scene of a grasped cell in MuJoCo."""
    low = -cell.scene.grasp.height_mm
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{dt_s}" gravity="0 0 0" cone="elliptic" impratio="100" integrator="implicitfast"
      solver="Newton" iterations="100" tolerance="1e-14" ccd_tolerance="1e-10"/>
    <default><geom solref="{CONTACT_S} 1" solimp="{STIFF} {STIFF} 0.001"/></default>
    <asset>{_prism("foot", cell.foot, low, low + 5.0)}{_prism("grip", _held_outline(cell), -13.0, 13.0)}</asset>
    <worldbody>
      <body name="object"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
      <geom type="mesh" mesh="foot" contype="4" conaffinity="2"/>
      <geom type="mesh" mesh="grip" contype="8" conaffinity="1"/></body>
      {_tips(cell)}
      <body name="blocks" mocap="true" pos="0 0 {(low - START_MM) / 1e3}">
      <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      {_beads(cell, x_mm, theta_deg)}</body>
    </worldbody></mujoco>""")


def press(cell: Cell, x_mm: float, theta_deg: float, depth_mm: float, dt_s: float, slower: float = 1.0) -> Pressed:
    """Raise the blocks to depth_mm above the object's resting bottom, wait, and look."""
    model = model_of(cell, x_mm, theta_deg, dt_s)
    data = mujoco.MjData(model)
    high = (depth_mm - cell.scene.grasp.height_mm) / 1e3
    low = -(cell.scene.grasp.height_mm + START_MM) / 1e3
    rise_s = slower * (high - low) / RISE_M_S
    steps = int(np.ceil((rise_s + 3.0 * HOLD_S) / dt_s))
    for i in range(steps):
        share = np.clip((i * dt_s - HOLD_S) / rise_s, 0.0, 1.0)
        data.mocap_pos[0, 2] = low + share * (high - low)
        data.qfrc_applied[:6] = -DAMPING * data.qvel[:6]
        mujoco.mj_step(model, data)
    body = model.body("object").id
    quaternion = data.xquat[body]
    turn = np.empty(3)
    mujoco.mju_quat2Vel(turn, quaternion, 1.0)
    return Pressed(_block_force(model, data, body), np.degrees(turn))


def _block_force(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """Sum of the contact forces of the blocks on the object, hand frame."""
    total, wrench, blocks = np.zeros(3), np.zeros(6), model.body("blocks").id
    for index in range(data.ncon):
        contact = data.contact[index]
        first, second = (model.geom_bodyid[g] for g in contact.geom)
        if blocks in (first, second):
            mujoco.mj_contactForce(model, data, index, wrench)
            force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second geom's body
            total += force if second == body else -force
    return total
