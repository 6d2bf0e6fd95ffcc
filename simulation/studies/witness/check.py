"""Probes of the foreign cell against CalculiX: the same plate on the same path presses the same pad."""

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.cell import CLOSING_STEPS, ForeignCell, pad_of
from simulation.foreign.elements import Pad
from simulation.foreign.newton import Drive
from simulation.foreign.pads import OPEN, Grip
from simulation.scene.scene import APPROACH_MM, Scene
from simulation.scene.worlds import load_scene
from simulation.studies.witness import calculix
from simulation.studies.witness.calculix import Mesh, Rubber

Array = NDArray[np.float64]

FLAT = {"grasp.pre_tilt_spread_deg": 0.0, "grasp.pre_yaw_spread_deg": 0.0, "gel.crown_mm": 0.0, "gel.friction": 0.8}
CELLS = (6, 2, 6)  # of CalculiX's mesh: its nodes lie on nodes of ours
CLEAR_MM = 0.01
SLIDES = 0.98  # share of the friction limit: penalty friction never quite reaches it
TOUCHES = 0.02  # share of the mean pressure
SAME_MM, LEAST_SHARED = 1e-3, 40


@dataclass(frozen=True, slots=True)
class Probe:
    """One probe: a rectangle's start error, its depth below first touch (0: it only hangs), the scene."""

    kind: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    x_mm: float = 0.0
    theta_deg: float = 0.0
    depth_mm: float = 0.0
    side: int = 1

    def scene(self) -> Scene:
        """The scene, on fixed blocks."""
        return load_scene("rectangle", blocks__free=False).varied({**FLAT, **self.changes})


def _gel(nu: float, margin: float | None, thickness: float = 2.5, **other: float) -> dict[str, Any]:
    out: dict[str, Any] = {"gel.poisson_ratio": nu, "gel.thickness_mm": thickness}
    if margin is not None:
        out["gel.margin_mm"] = [margin, margin]
    return out | {name.replace("__", "."): value for name, value in other.items()}


PROBES = (
    Probe("pressing", _gel(0.45, 0.0)),
    Probe("pressing", _gel(0.48, 2.0)),
    Probe("pressing", _gel(0.49, 1.0, grasp__force_n=10.0)),
    Probe("pressing", _gel(0.48, None, thickness=1.5)),
    Probe("pressing", _gel(0.48, 0.5, thickness=4.0)),
    Probe("pressing, plate askew", _gel(0.48, 1.0, grasp__pre_yaw_spread_deg=2.0)),
    Probe("shear, slipping in part", _gel(0.45, 0.0, object__mass_kg=2.0)),
    Probe("shear, slipping in part", _gel(0.48, 0.0, object__mass_kg=1.6)),
    Probe("shear, slipping in part", _gel(0.48, 2.0, object__mass_kg=2.0, gel__friction=0.6)),
    Probe("shear, slipping in part", _gel(0.49, 1.0, object__mass_kg=1.5)),
    Probe("shear, slipping in part", _gel(0.48, None, object__mass_kg=2.0)),
    Probe("shear, slipping in part", _gel(0.48, 0.5, thickness=4.0, object__mass_kg=2.0)),
    Probe("one edge", _gel(0.48, 0.0), 8.0, 0.0, 0.6),
    Probe("one edge", _gel(0.48, 0.0), 8.0, 0.0, 1.5),
    Probe("one edge", _gel(0.45, 2.0), 8.0, 0.0, 1.0),
    Probe("one edge", _gel(0.49, 1.0), -5.0, 0.0, 1.0),
    Probe("one edge", _gel(0.48, None), 8.0, 0.0, 1.0),
    Probe("one edge", _gel(0.48, 1.0, gel__friction=0.5), 12.0, 0.0, 1.2),
    Probe("yawed edge", _gel(0.48, 0.0), 8.0, 5.0, 1.0),
    Probe("yawed edge", _gel(0.48, 0.0), 8.0, 5.0, 1.0, -1),
    Probe("yawed edge", _gel(0.45, 2.0), 8.0, 10.0, 1.2),
    Probe("yawed edge", _gel(0.49, 1.0), -6.0, 8.0, 0.8),
    Probe("yawed edge", _gel(0.48, None), 8.0, 5.0, 1.0),
    Probe("yawed edge", _gel(0.48, 1.0, gel__friction=0.5), 10.0, -6.0, 1.2, -1),
)


class RecordedCell(ForeignCell):
    """A foreign cell that stores the object's pose in the hand at the end of each load step since the grasp."""

    def __init__(self, scene: Scene, seed: int = 0, pad: Pad | None = None) -> None:
        self.path: list[Grip] = []
        super().__init__(scene, seed, pad)

    def _close(self, turn: Array) -> None:
        self.path = []
        super()._close(turn)

    def _rests(self, drive: Drive, travel: Array | None = None) -> bool:
        rests = super()._rests(drive, travel)
        if rests:
            self.path.append(self.grip.copy())
        return rests


def played(probe: Probe, pad: Pad | None = None, **numerics: float) -> RecordedCell:
    """The probe in the foreign cell, at its end."""
    scene = probe.scene().varied({f"numerics.{name}": value for name, value in numerics.items()})
    cell = RecordedCell(scene, 3, pad)
    cell.regrasp(probe.x_mm, probe.theta_deg)
    if probe.depth_mm:
        x, y, z, yaw = cell.pose
        cell.move_to(x, y, z - APPROACH_MM - probe.depth_mm, float(np.degrees(yaw)))
    return cell


def tried(probe: Probe) -> dict[str, Any]:
    try:
        return compared(probe)
    except calculix.CalculixError as error:
        return asdict(probe) | {"failed": str(error)[:200]}


def compared(probe: Probe, cells: tuple[int, int, int] = CELLS) -> dict[str, Any]:
    """Both answers to a probe and their difference. Raises CalculixError."""
    began = time.process_time()
    cell = played(probe)
    ours_s, gel = time.process_time() - began, cell.scene.gel
    pad = pad_of(cell.scene)
    rubber = Rubber(gel.shear_modulus_n_per_mm2, pad.poisson_ratio, gel.friction)
    path, began = _way(cell, probe.side), time.monotonic()
    theirs = calculix.press(Mesh(pad, probe.side, cells), rubber, probe.side, path)
    row = asdict(probe) | {"poisson_ratio": pad.poisson_ratio, "thickness_mm": gel.thickness_mm}
    return row | {"ours_cpu_s": ours_s, "calculix_s": time.monotonic() - began} | _apart(cell, probe.side, theirs)


def large(probe: Probe) -> dict[str, Any]:
    """The effect of large strains on a probe's path, by CalculiX. Raises CalculixError."""
    cell = played(probe)
    gel, pad = cell.scene.gel, pad_of(cell.scene)
    path, mesh = _way(cell, probe.side), Mesh(pad, probe.side, CELLS)
    rubber = Rubber(gel.shear_modulus_n_per_mm2, pad.poisson_ratio, gel.friction)
    small, finite = (calculix.press(mesh, rubber._replace(large=large), probe.side, path) for large in (False, True))
    sheared = [float(np.linalg.norm(answer.force[[0, 2]])) for answer in (small, finite)]
    return {
        "kind": probe.kind,
        "strain": float(np.abs(small.moved[:, 1]).max() / gel.thickness_mm),
        "normal": float(finite.force[1] / small.force[1] - 1.0),
        "shear": sheared[1] / sheared[0] - 1.0,
        "moved": float(np.linalg.norm(finite.moved - small.moved) / np.linalg.norm(small.moved)),
    }


def _way(cell: RecordedCell, side: int) -> list[Array]:
    """The plate's corners at every third load step in the frame of the pad at side, starting clear of it."""
    crest, closed = cell.held.crest_mm, CLOSING_STEPS - 1
    kept = [*cell.path[:closed:3], *cell.path[closed : closed + 2], *cell.path[: closed + 1 : -3][::-1]]
    way = [
        calculix.plate_at(grip.turn, grip.place - [0.0, 0.5 * side * grip.opening, 0.0], crest, side) for grip in kept
    ]
    face = way[0][CORNER_ROWS[side]]
    into = float((side * face[:, 1]).max())
    return [way[0] - [0.0, side * (into + CLEAR_MM), 0.0], *way]


LARGE = tuple(PROBES[i] for i in (0, 7, 12))
"""Probes that are also tried with large strains."""
CORNER_ROWS = {1: [2, 3, 6, 7], -1: [0, 1, 4, 5]}
"""The plate's corners that face the pad."""


def _apart(cell: RecordedCell, side: int, theirs: calculix.Answer) -> dict[str, Any]:
    count, first = cell.pads.count, 0 if side > 0 else cell.pads.count
    mine = slice(first, first + count)
    grip = cell.grip
    rest = cell.pads.rested(grip.opening)[mine]
    moved, force = (grip.points[mine] - rest), cell.pads.forces(grip)[mine].sum(axis=0)
    same, at = _shared(rest[:, [0, 2]], theirs.rest[:, [0, 2]])
    size: Array = theirs.moved[at]
    apart: Array = moved[same] - size
    places = rest[same][:, [0, 2]]
    ends = np.isclose(np.abs(places), np.abs(places).max(axis=0))
    rim, weight = ends.any(axis=1), np.where(ends, 0.5, 1.0).prod(axis=1)
    weight = weight / weight.sum()
    across, across_theirs = force[[0, 2]], theirs.force[[0, 2]]
    pressure, shear = theirs.pressure[at], theirs.shear[at]
    touching = pressure > TOUCHES * float(pressure.mean())
    slides = touching & (shear >= SLIDES * cell.scene.gel.friction * pressure)
    terms = cell.pads.evaluate(grip, cell.pads.planes(cell.held, grip.on), grip.on, None)
    ours, drag = terms.pressing[mine][same], np.linalg.norm(terms.drag[mine][same], axis=1)
    closed = grip.status[mine][same] != OPEN
    return {
        "force_n": [force.tolist(), theirs.force.tolist()],
        "normal_apart": abs(force[1] / theirs.force[1] - 1.0),
        "shear_n": float(np.linalg.norm(across_theirs)),
        "shear_apart": float(np.linalg.norm(across - across_theirs) / np.linalg.norm(across_theirs)),
        "moved_rms_mm": float(np.sqrt(np.square(size).sum(axis=1) @ weight)),
        "moved_apart": _apart_of(apart, size, weight),
        "moved_apart_inside": _apart_of(apart[~rim], size[~rim], weight[~rim]),
        "slip": [_share(closed & (drag >= SLIDES * cell.pads.friction * ours), closed), _share(slides, touching)],
    }


def _apart_of(apart: Array, size: Array, weight: Array) -> float:
    """RMS of a difference over RMS of a field, both [m, 3], each node weighted by its area of the face."""
    return float(np.sqrt((np.square(apart).sum(axis=1) @ weight) / (np.square(size).sum(axis=1) @ weight)))


def _share(some: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
    return float(some.sum() / np.maximum(1, of.sum()))


def _shared(ours: Array, theirs: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The nodes of ours [m] and of theirs [m] in the same places. Raises ValueError where too few coincide."""
    away = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    mine, of_theirs = np.nonzero(away < SAME_MM)
    if len(mine) < LEAST_SHARED:
        raise ValueError(f"expected at least {LEAST_SHARED} nodes in the same places, found {len(mine)}")
    return mine, of_theirs
