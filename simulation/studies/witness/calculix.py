"""A gel pad under a rigid plate in CalculiX, a third party's finite elements (the program `ccx`; Dhondt 2004).

Serendipity bricks with reduced integration (C3D20R), surface-to-surface penalty contact with Coulomb friction: element,
contact and iteration all differ from `simulation.foreign`. The plate follows a prescribed path.
"""

import os
import re
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from simulation.foreign.elements import Pad

Array = NDArray[np.float64]
Ids = NDArray[np.intp]

PLATE_MM, PLATE_THICK_MM = 60.0, 3.0
SINK_PER_MODULUS = 200.0  # contact stiffness, 1/mm: a pressure of a tenth of Young's modulus sinks in by 0.5 um
STICK_SHARE = 0.2  # share of that stiffness while it sticks
REACH_THICKNESSES = 3.0
LONGEST_S = 3600.0
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 2], [2, 0, 2], [2, 2, 2], [0, 2, 2]])
EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
TOWARDS_LOW_Y, TOWARDS_HIGH_Y = "S3", "S5"  # faces of a brick


class Rubber(NamedTuple):
    """A gel: shear modulus, N/mm2, Poisson's ratio and friction; large: Neo-Hookean, with finite motion."""

    shear_modulus: float
    poisson_ratio: float
    friction: float
    large: bool = False


class Answer(NamedTuple):
    """The m nodes of the pad's face at the end of a path, and the plate's force on it.

    rest, moved [m, 3]: place at rest and displacement, mm. pressure, shear [m], N/mm2. force [3], N.
    """

    rest: Array
    moved: Array
    pressure: Array
    shear: Array
    force: Array


class CalculixError(Exception):
    """The program did not converge, or its output cannot be read."""


def is_installed() -> bool:
    """Whether there is a `ccx` to run."""
    return shutil.which("ccx") is not None


class Mesh:
    """A pad of bricks on the side of +y or -y (side 1, -1), its face at y = 0 and bonded at its back."""

    def __init__(self, pad: Pad, side: int, cells: tuple[int, int, int]) -> None:
        across = [_borders(size, margin, count, pad.thickness_mm)
                  for size, margin, count in ((pad.width_mm, pad.margin_mm[0], cells[0]),
                                              (pad.height_mm, pad.margin_mm[1], cells[2]))]  # fmt: skip
        through: Array = np.linspace(0.0, pad.thickness_mm, cells[1] + 1)
        lines = (across[0], through if side > 0 else through[::-1] * -1.0, across[1])
        fine = [_halved(each) for each in lines]
        shape = tuple(len(each) for each in fine)
        at = np.stack(np.meshgrid(*(np.arange(0, 2 * (len(each) - 1), 2) for each in lines), indexing="ij"), -1)
        middles = [(CORNERS[a] + CORNERS[b]) // 2 for a, b in EDGES]
        places = at.reshape(-1, 1, 3) + np.concatenate([CORNERS, middles])
        self.bricks = 1 + np.ravel_multi_index(tuple(np.moveaxis(places, -1, 0)), shape)
        self.ids: Ids = np.unique(self.bricks)
        self.places = np.stack([line[i] for line, i in zip(fine, np.unravel_index(self.ids - 1, shape), strict=True)],
                               axis=1)  # fmt: skip
        y, half = self.places[:, 1], 0.5 * np.array([pad.width_mm, pad.height_mm]) + 1e-9
        inside = (np.abs(self.places[:, [0, 2]]) <= half).all(axis=1)
        self.face, self.back = self.ids[(np.abs(y) < 1e-9) & inside], self.ids[np.abs(y) > pad.thickness_mm - 1e-9]
        touching = np.isin(self.bricks[:, :8], self.face).sum(axis=1) == 4
        self.slaves: Ids = 1 + np.flatnonzero(touching)
        self.slave_face = TOWARDS_LOW_Y if side > 0 else TOWARDS_HIGH_Y


def _borders(size_mm: float, margin_mm: float, count: int, thickness_mm: float) -> Array:
    """Borders of elements across a pad; a margin is divided into two elements."""
    inner: Array = np.linspace(-0.5 * size_mm, 0.5 * size_mm, count + 1)
    margin_mm = min(margin_mm, REACH_THICKNESSES * thickness_mm)
    if margin_mm < 1e-6:
        return inner
    outer = inner[-1] + margin_mm * np.array([1.0, 3.0]) / 3.0
    return np.concatenate([-outer[::-1], inner, outer])


def _halved(lines: Array) -> Array:
    out = np.repeat(lines, 2)[:-1]
    out[1::2] = 0.5 * (lines[:-1] + lines[1:])
    return out


def plate_at(turn: Array, place: Array, crest_mm: float, side: int) -> Array:
    """Corners [8, 3] of the held object's flat side in the pad's frame, for the object's turn and place."""
    across = 0.5 * PLATE_MM * (CORNERS[:, [0, 2]] - 1.0)
    low = crest_mm - PLATE_THICK_MM if side > 0 else -crest_mm
    corners = np.stack([across[:, 0], low + 0.5 * PLATE_THICK_MM * CORNERS[:, 1], across[:, 1]], axis=1)
    return np.asarray(corners @ turn.T + place)


def press(mesh: Mesh, rubber: Rubber, side: int, path: Sequence[Array]) -> Answer:
    """Move the plate [8, 3] along a path, its first corners clear of the pad. Raises CalculixError."""
    with TemporaryDirectory() as folder:
        deck = Path(folder) / "pad.inp"
        deck.write_text("\n".join(_deck(mesh, rubber, side, path)) + "\n")
        environment = os.environ | {"OMP_NUM_THREADS": "1", "CCX_NPROC_EQUATION_SOLVER": "1"}
        try:
            ended = subprocess.run(
                ["ccx", "-i", "pad"], cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST_S,
                check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise CalculixError(f"no end within {LONGEST_S:g} s") from error
        if ended.returncode or "Job finished" not in ended.stdout:
            raise CalculixError(f"status {ended.returncode}: {ended.stdout[-300:]}")
        return _answer(mesh, deck)


def _deck(mesh: Mesh, rubber: Rubber, side: int, path: Sequence[Array]) -> Iterator[str]:
    plate_ids = int(mesh.ids[-1]) + 1 + np.arange(8)
    count, other = len(mesh.bricks), TOWARDS_HIGH_Y if side > 0 else TOWARDS_LOW_Y
    yield "*NODE, NSET=ALL"
    for number, place in zip((*mesh.ids, *plate_ids), (*mesh.places, *path[0]), strict=True):
        yield f"{number}, {place[0]:.9g}, {place[1]:.9g}, {place[2]:.9g}"
    yield "*ELEMENT, TYPE=C3D20R, ELSET=GEL"
    for number, nodes in enumerate(mesh.bricks, 1):
        yield f"{number}, {', '.join(map(str, nodes[:15]))},"
        yield ", ".join(map(str, nodes[15:]))
    yield f"*ELEMENT, TYPE=C3D8, ELSET=PLATE\n{count + 1}, {', '.join(map(str, plate_ids))}"
    for name, nodes in (("FACE", mesh.face), ("BACK", mesh.back)):
        yield f"*NSET, NSET={name}"
        yield from (f"{number}," for number in nodes)
    yield "*SURFACE, NAME=SLAVE, TYPE=ELEMENT"
    yield from (f"{number}, {mesh.slave_face}" for number in mesh.slaves)
    yield f"*SURFACE, NAME=MASTER, TYPE=ELEMENT\n{count + 1}, {other}"
    yield from _laws(rubber)
    yield "*BOUNDARY\nBACK, 1, 3, 0."
    for number, corners in enumerate(path[1:], 2):
        yield "*STEP, INC=400" + (", NLGEOM" if rubber.large else "")
        yield "*STATIC\n1., 1., 1e-4, 1.\n*BOUNDARY"
        for node, moved in zip(plate_ids, corners - path[0], strict=True):
            yield from (f"{node}, {axis}, {axis}, {value:.12g}" for axis, value in enumerate(moved, 1))
        if number == len(path):
            yield "*NODE PRINT, NSET=FACE, FREQUENCY=999\nU\n*NODE PRINT, NSET=BACK, TOTALS=ONLY, FREQUENCY=999\nRF"
            yield "*CONTACT FILE, FREQUENCY=999\nCDIS, CSTR"
        yield "*END STEP"


def _laws(rubber: Rubber) -> Iterator[str]:
    shear, ratio = rubber.shear_modulus, rubber.poisson_ratio
    young, bulk = 2.0 * shear * (1.0 + ratio), 2.0 * shear * (1.0 + ratio) / (3.0 * (1.0 - 2.0 * ratio))
    yield "*MATERIAL, NAME=RUBBER"
    if rubber.large:
        yield f"*HYPERELASTIC, NEO HOOKE\n{0.5 * shear:.9g}, {2.0 / bulk:.9g}"
    else:
        yield f"*ELASTIC\n{young:.9g}, {ratio:.9g}"
    yield "*MATERIAL, NAME=STEEL\n*ELASTIC\n210000., 0.3"
    yield "*SOLID SECTION, ELSET=GEL, MATERIAL=RUBBER\n*SOLID SECTION, ELSET=PLATE, MATERIAL=STEEL"
    stiff = SINK_PER_MODULUS * young
    yield f"*SURFACE INTERACTION, NAME=TOUCH\n*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR\n{stiff:.9g}"
    yield f"*FRICTION\n{rubber.friction:.9g}, {STICK_SHARE * stiff:.9g}"
    yield "*CONTACT PAIR, INTERACTION=TOUCH, TYPE=SURFACE TO SURFACE\nSLAVE, MASTER"


def _answer(mesh: Mesh, deck: Path) -> Answer:
    printed = deck.with_suffix(".dat").read_text()
    moved = np.array([line.split() for line in _block(printed, "displacements")], float)
    force = np.array(_block(printed, "total force")[-1].split()[:3], float)
    touch = _contact(deck.with_suffix(".frd").read_text())
    index = {int(number): place for number, place in zip(mesh.ids, mesh.places, strict=True)}
    numbers = moved[:, 0].astype(int)
    felt = np.array([touch.get(number, (0.0, 0.0, 0.0)) for number in numbers])
    rest = np.array([index[number] for number in numbers])
    return Answer(rest, moved[:, 1:], felt[:, 0], np.hypot(felt[:, 1], felt[:, 2]), -force)


def _block(text: str, title: str) -> list[str]:
    """Lines of numbers below the last heading that begins with a title."""
    blocks = list(re.finditer(rf"^ {title}.*\n\n((?: +[-\d].*\n?)+)", text, re.MULTILINE))
    if not blocks:
        raise CalculixError(f"no {title!r} in what it printed")
    return blocks[-1].group(1).splitlines()


def _contact(text: str) -> dict[int, tuple[float, float, float]]:
    """By node: pressure and the two shears of the last contact block; columns are 12 wide, maybe without blanks."""
    begin = text.rfind("-4  CONTACT")
    if begin < 0:
        raise CalculixError("no contact in what it wrote")
    out = {}
    for line in text[begin:].splitlines()[1:]:
        if line.startswith(" -3"):
            break
        if line.startswith(" -1"):
            values = [float(line[13 + 12 * column : 25 + 12 * column]) for column in range(6)]
            out[int(line[3:13])] = (values[3], values[4], values[5])
    return out
