"""A grasped cell as a MuJoCo model: pads of sprung tips, the ends of a block's edge rows of small beads.

MuJoCo is given the pads' opening, stiffnesses, frictions and places, and integrates Newton's equations in time with
its own convex contact solver. It knows nothing of load steps, return mapping or our contact geometry. Hand frame;
units mm, ms, g and so N; the blocks move towards the resting hand.

A pad's nodes are tips in one of two ways. As one sprung tip each, rubbing on the held surface: where that leans,
friction carries part of the slope and the friction cone leans too. Or `apart`, which is our law: pressure acts through
a tip that only moves into the pad, without friction, and shear through a second one that is pinched with that pressure.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from simulation.data.probe import QuasiStaticCell

TIP_G = 1.0
TIP_MM, START_MM = 0.02, 0.05
ENDS_MM, PITCH_MM = 1.5, 0.25  # beads about an end of an edge under the footprint
SIDE_MM = 60.0


@dataclass(frozen=True)
class Effort:
    """Accuracy settings of MuJoCo: time step, slow motion, hard contacts (impedance, time), small beads."""

    dt_ms: float
    motion_ms: float
    hardness: float
    contact_ms: float
    bead_mm: float


def _prism(name: str, outline: np.ndarray, low_mm: float, high_mm: float) -> str:
    points = "  ".join(f"{x:.9g} {y:.9g} {z:.9g}" for z in (low_mm, high_mm) for x, y in outline)
    return f'<mesh name="{name}" vertex="{points}"/>'


def _held_surface(cell: QuasiStaticCell) -> tuple[str, str]:
    """Mesh and geoms of the held section, a tip's radius inside it, so that the tips' centres run on it.

    Flats are boxes and round corners cylinders, which MuJoCo meets exactly; only an ellipse is a fine polygon.
    """
    crest, flat, rx, ry, slope = (float(value) for value in cell.constants["profile"][0])
    touch = 'contype="8" conaffinity="1"'
    geoms = []
    if flat > 0.0:
        geoms.append(f'<geom type="box" size="{flat:.9g} {(crest - TIP_MM):.9g} 13" {touch}/>')
    if slope > 0.0:
        return "", geoms[0]
    if rx == ry:
        geoms += [
            f'<geom type="cylinder" size="{(rx - TIP_MM):.9g} 13" pos="{x:.9g} {y:.9g} 0" {touch}/>'
            for x in {flat, -flat}
            for y in {crest - ry, ry - crest}
        ]
        return "", "".join(geoms)
    turn = np.linspace(-1.12, 1.12, 800)
    along = np.column_stack([np.sin(turn) / rx, np.cos(turn) / ry])
    inwards = TIP_MM * along / np.linalg.norm(along, axis=1)[:, None]
    top = np.column_stack([rx * np.sin(turn), crest - ry * (1.0 - np.cos(turn))]) - inwards
    return _prism("grip", np.concatenate([top, -top]), -13.0, 13.0), f'<geom type="mesh" mesh="grip" {touch}/>'


def _slides(**springs: float) -> str:
    """Joints along axes with stiffness in N/mm, critically damped; a negative stiffness is damping alone."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    return "".join(
        f'<joint type="slide" axis="{axes[name]}" stiffness="{max(k, 0.0):.9g}" '
        f'damping="{2.0 * np.sqrt(abs(k) * TIP_G):.9g}"/>'
        for name, k in springs.items()
    )


def _tip(name: str, place_mm: tuple[float, float, float], joints: str, contact: str) -> str:
    x, y, z = place_mm
    return (
        f'<body name="{name}" pos="{x:.9g} {y:.9g} {z:.9g}">{joints}'
        f'<geom type="sphere" size="{TIP_MM}" mass="{TIP_G}" priority="1" {contact}/></body>'
    )


def _tips(cell: QuasiStaticCell, *, apart: bool) -> str:
    constants, opening = cell.constants[0], float(cell.state["opening"])
    kt, kn = (float(constants[name] * constants["area"]) for name in ("kt", "kn"))
    rubs = f'friction="{cell.scene.gel.friction} 0 0" condim="3"'
    on_object, on_side = 'contype="1" conaffinity="8"', 'contype="16" conaffinity="32"'
    parts = []
    for i, node in enumerate(cell.nodes):
        place = (node["x"], node["side"] * (0.5 * opening + node["crown"]), node["z"])
        if not apart:
            parts.append(_tip(f"press{i}", place, _slides(x=kt, y=kn, z=kt), f"{on_object} {rubs}"))
            continue
        beside = (node["x"], node["side"] * (0.5 * opening + TIP_MM), node["z"])
        parts.append(_tip(f"press{i}", place, _slides(y=kn), f'{on_object} condim="1"'))
        parts.append(_tip(f"shear{i}", beside, _slides(x=kt, y=-kn, z=kt), f"{on_side} {rubs}"))
    return "".join(parts)


def _ends_mm(cell: QuasiStaticCell, x_mm: float, theta_deg: float) -> list[tuple[float, float]]:
    """Where the blocks' edges enter and leave the footprint, world frame."""
    turn = np.radians(theta_deg)
    x = cell.foot @ [np.cos(turn), -np.sin(turn)] + x_mm
    y = cell.foot @ [np.sin(turn), np.cos(turn)]
    ends = []
    for edge in (0.5 * cell.scene.blocks.gap_mm, -0.5 * cell.scene.blocks.gap_mm):
        for x0, y0, x1, y1 in zip(x, y, np.roll(x, -1), np.roll(y, -1), strict=True):
            if (x0 - edge) * (x1 - edge) < 0.0:
                ends.append((edge, y0 + (edge - x0) / (x1 - x0) * (y1 - y0)))
    return ends


def _beads(cell: QuasiStaticCell, bead_mm: float) -> str:
    x_mm, theta_deg = cell.look().object_error
    # a skew object bears on the last bead alone, which changes as it slides; a coarse row would kick it
    pitch = 0.6 * bead_mm if abs(theta_deg) > 1e-9 else PITCH_MM
    reach = np.arange(-ENDS_MM, ENDS_MM, pitch) + 0.5 * pitch
    return "".join(
        f'<geom type="sphere" size="{bead_mm}" contype="2" conaffinity="4" condim="3" priority="1" '
        f'pos="{x:.9g} {y:.9g} {-bead_mm}" friction="{cell.scene.blocks.friction} 0 0"/>'
        for x, end in _ends_mm(cell, x_mm, theta_deg)
        for y in end + reach
    )


def model_of(cell: QuasiStaticCell, effort: Effort, *, apart: bool) -> mujoco.MjModel:
    """The scene of a cell that has just grasped its object."""
    low = -cell.scene.grasp.height_mm
    side = (
        f'<geom name="plate" type="box" contype="32" conaffinity="16" '
        f'size="{SIDE_MM} {0.5 * float(cell.state["opening"]):.9g} {SIDE_MM}"/>'
    )
    mesh, held = _held_surface(cell)
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="{effort.dt_ms}" gravity="0 0 0" cone="elliptic" impratio="100" integrator="implicitfast"
      solver="Newton" iterations="100" tolerance="0" ccd_tolerance="1e-10"/>
    <default><geom solref="{effort.contact_ms} 1" solimp="{effort.hardness} {effort.hardness} 1"/></default>
    <asset>{_prism("foot", cell.foot, low, low + 5.0)}{mesh}</asset>
    <worldbody>
      <body name="object"><freejoint/><inertial pos="0 0 0" mass="1000" diaginertia="1e6 1e6 1e6"/>
      <geom type="mesh" mesh="foot" contype="4" conaffinity="2"/>{held}{side if apart else ""}</body>
      {_tips(cell, apart=apart)}
      <body name="blocks" mocap="true"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      {_beads(cell, effort.bead_mm)}</body>
    </worldbody></mujoco>""")
