"""The same poke in MuJoCo: every node of a pad a sprung tip, a block's edge a row of fixed beads.

An independent check of equilibrium, friction and contact: MuJoCo integrates Newton's equations in time with its own
convex contact solver, knows nothing of load steps, return mapping or our contact geometry, and is given only the
pads' openings, stiffnesses and places. Hand frame, SI units; the blocks rise towards the resting hand.

`python -m tests.simulation.mujoco_bench` prints the comparison of docs/mujoco.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from simulation.probe import Cell
from simulation.scene import load_scene

TIP_KG, RISE_M_S, HOLD_S = 1e-3, 0.005, 0.05
CONTACT_S = 1e-3
DAMPING = np.array([300.0, 300.0, 300.0, 0.06, 0.06, 0.06])  # of the object, N s/m and N m s/rad: it must not ring
DEPTH_MM = 1.0  # of the poke past touchdown
BEAD_MM, TIP_MM, BEAD_PITCH_MM, INSET_MM, START_MM = 0.1, 0.1, 2.0, 1.0, 0.05


@dataclass(frozen=True)
class Effort:
    """What buys accuracy with time in MuJoCo: time step, how much slower than RISE_M_S, and the contacts' hardness."""

    dt_s: float
    slower: float
    hardness: float


COARSE, FINE = Effort(2e-4, 2.0, 0.999), Effort(1e-4, 5.0, 0.9995)


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


def model_of(cell: Cell, x_mm: float, theta_deg: float, effort: Effort) -> mujoco.MjModel:
    """The scene of a grasped cell in MuJoCo."""
    low = -cell.scene.grasp.height_mm
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{effort.dt_s}" gravity="0 0 0" cone="elliptic" impratio="100" integrator="implicitfast"
      solver="Newton" iterations="100" tolerance="1e-14" ccd_tolerance="1e-10"/>
    <default><geom solref="{CONTACT_S} 1" solimp="{effort.hardness} {effort.hardness} 0.001"/></default>
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


def press(cell: Cell, x_mm: float, theta_deg: float, effort: Effort) -> Pressed:
    """Raise the blocks to DEPTH_MM above the object's resting bottom, wait, and look."""
    model = model_of(cell, x_mm, theta_deg, effort)
    data = mujoco.MjData(model)
    high = (DEPTH_MM - cell.scene.grasp.height_mm) / 1e3
    low = -(cell.scene.grasp.height_mm + START_MM) / 1e3
    rise_s = effort.slower * (high - low) / RISE_M_S
    for i in range(math.ceil((rise_s + 3.0 * HOLD_S) / effort.dt_s)):
        share = np.clip((i * effort.dt_s - HOLD_S) / rise_s, 0.0, 1.0)
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


SCENES = (
    ("rectangle", 8.0, 0.0),
    ("rectangle", 8.0, 5.0),
    ("hexagon", 10.0, 0.0),
    ("white_box", 6.0, 0.0),
    ("white_box", 8.0, 4.0),
    ("circle", 8.0, 0.0),
    ("ellipse", 8.0, 0.0),
    ("can", 8.0, 5.0),
)
NODES = 6
SETTINGS = {
    "grasp__pre_tilt_spread_deg": 0.0,
    "grasp__pre_yaw_spread_deg": 0.0,
    "effects__gravity": "off",
    "blocks__free": False,
    "blocks__stiffness_n_per_mm": 50000.0,
    "gel__node_rows": NODES,
    "gel__node_columns": NODES,
}


def ours(name: str, x_mm: float, theta_deg: float, load_step_mm: float) -> tuple[Cell, Pressed]:
    """A freshly grasped cell, and the end of the poke by our own mechanics."""
    cell = Cell(load_scene(name, numerics__load_step_mm=load_step_mm, **SETTINGS))
    cell.regrasp(x_mm, theta_deg)
    state = cell.move_to(cell.pose[0], 0.0, cell.scene.grasp.height_mm - DEPTH_MM, theta_deg)
    cell.regrasp(x_mm, theta_deg)
    return cell, Pressed(state.wrench_n_nmm[:3], np.degrees(state.in_hand[3:]))


@dataclass(frozen=True)
class Comparison:
    """Both simulators on one scene; distances are norms of vectors, errors those under refinement of each."""

    ours: Pressed
    theirs: Pressed
    force_apart_n: float
    force_errors_n: float
    turn_apart_deg: float
    turn_errors_deg: float

    @property
    def agree(self) -> bool:
        """Within the sum of both refinement errors."""
        return self.force_apart_n <= self.force_errors_n and self.turn_apart_deg <= self.turn_errors_deg


def compare(name: str, x_mm: float, theta_deg: float) -> Comparison:
    """Both simulators, each at two efforts, on one poke."""
    cell, coarse = ours(name, x_mm, theta_deg, 0.17)
    _, fine = ours(name, x_mm, theta_deg, 0.02)
    rough, good = (press(cell, x_mm, theta_deg, effort) for effort in (COARSE, FINE))

    def apart(one: Pressed, other: Pressed) -> tuple[float, float]:
        return float(np.linalg.norm(one.force_n - other.force_n)), float(np.linalg.norm(one.turn_deg - other.turn_deg))

    mine, yours, both = apart(coarse, fine), apart(rough, good), apart(coarse, good)
    return Comparison(coarse, good, both[0], mine[0] + yours[0], both[1], mine[1] + yours[1])


def main() -> None:
    print(
        "| scene | x mm, yaw deg | force N: ours, MuJoCo | apart, allowed | turn deg: ours, MuJoCo | apart, allowed | |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, x_mm, theta_deg in SCENES:
        found = compare(name, x_mm, theta_deg)
        force = [float(np.linalg.norm(end.force_n)) for end in (found.ours, found.theirs)]
        turn = [float(np.linalg.norm(end.turn_deg)) for end in (found.ours, found.theirs)]
        print(
            f"| {name} | {x_mm:g}, {theta_deg:g} | {force[0]:.3f}, {force[1]:.3f} | {found.force_apart_n:.3f}, "
            f"{found.force_errors_n:.3f} | {turn[0]:.4f}, {turn[1]:.4f} | {found.turn_apart_deg:.4f}, "
            f"{found.turn_errors_deg:.4f} | {'agrees' if found.agree else 'apart'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
