"""The same pokes in our mechanics and in MuJoCo, an independent check of equilibrium, friction and contact.

`python -m tests.simulation.physics.mujoco.bench --out docs` writes mujoco.json and mujoco.md (4 CPU minutes).
"""

import argparse
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import write_durably, write_json
from reporting.page import page
from reporting.table import Table, table
from simulation.data.probe import QuasiStaticCell
from simulation.scene.worlds import load_scene
from tests.simulation.physics.mujoco.model import Effort
from tests.simulation.physics.mujoco.press import Press, Pressed
from tests.simulation.physics.mujoco.scenes import DEEP, SETTINGS, SHALLOW, Poke

FINE = Effort(0.1, 1000.0, 0.9995, 0.5, 0.02)
COARSER = (Effort(0.1, 500.0, 0.9995, 0.5, 0.02), Effort(0.1, 1000.0, 0.998, 1.0, 0.08))  # twice as fast; softer
LOAD_STEPS_MM = (0.17, 0.02)
BETWEEN = "<!-- tables: written by the command below -->"
DEEP_HEAD = "The same and other scenes, pressed deeper so that objects tilt by 2 deg and more:"


def ours(poke: Poke, load_step_mm: float) -> tuple[QuasiStaticCell, Pressed]:
    """A freshly grasped cell, and the end of the poke by our own mechanics."""
    cell = QuasiStaticCell(load_scene(poke.scene, numerics__load_step_mm=load_step_mm, **{**SETTINGS, **poke.changes}))
    cell.regrasp(poke.x_mm, poke.theta_deg)
    x, _, _, yaw = cell.pose
    state = cell.move_to(x, 0.0, cell.scene.grasp.height_mm - poke.depth_mm, np.degrees(yaw))
    cell.regrasp(poke.x_mm, poke.theta_deg)
    return cell, Pressed(state.wrench_n_nmm[:3], np.degrees(state.in_hand[3:]), tuple(state.slipping_share))


def theirs(poke: Poke, cell: QuasiStaticCell, effort: Effort) -> Pressed:
    """The end of the poke by MuJoCo, from the grasp of a cell of ours."""
    return Press(cell, effort, poke.depth_mm, apart=poke.apart).run()


@dataclass(frozen=True)
class Comparison:
    """Both simulators on one poke: norms of vectors in N and deg, their distance, each one's refinement error."""

    scene: str
    error: str
    varied: str
    tips_apart: bool
    slipping_share: tuple[float, ...]
    force_n: tuple[float, float]
    turn_deg: tuple[float, float]
    force_apart_n: float
    force_errors_n: tuple[float, float]
    turn_apart_deg: float
    turn_errors_deg: tuple[float, float]

    @property
    def agree(self) -> bool:
        """Within the sum of both refinement errors."""
        return self.force_apart_n <= sum(self.force_errors_n) and self.turn_apart_deg <= sum(self.turn_errors_deg)


def _apart(one: Pressed, other: Pressed) -> tuple[float, float]:
    return float(np.linalg.norm(one.force_n - other.force_n)), float(np.linalg.norm(one.turn_deg - other.turn_deg))


def compare(poke: Poke) -> Comparison:
    """Both simulators at their finest on one poke.

    Refinement errors: ours between two load steps; MuJoCo's are what speed and softness change, one by one and summed,
    as they pull opposite ways (a fast object lags behind, a soft contact creeps).
    """
    (_, rough), (cell, mine) = (ours(poke, step) for step in LOAD_STEPS_MM)
    fine = theirs(poke, cell, FINE)
    (force, turn), own = _apart(mine, fine), _apart(rough, mine)
    other = np.sum([_apart(theirs(poke, cell, effort), fine) for effort in COARSER], axis=0).tolist()
    return Comparison(
        poke.scene,
        f"{poke.x_mm:g}, {poke.theta_deg:g}",
        poke.varied,
        poke.apart,
        mine.slipping_share,
        (float(np.linalg.norm(mine.force_n)), float(np.linalg.norm(fine.force_n))),
        (float(np.linalg.norm(mine.turn_deg)), float(np.linalg.norm(fine.turn_deg))),
        force,
        (own[0], other[0]),
        turn,
        (own[1], other[1]),
    )


def mujoco_table(rows: list[dict[str, Any]]) -> Table:
    """Rows of mujoco.json."""
    return table(
        rows,
        ("scene", "scene"),
        ("x mm, yaw deg", "error"),
        ("changed", "varied"),
        ("tips", lambda row: "two" if row["tips_apart"] else "one"),
        ("slip", lambda row: max(row["slipping_share"]), ".0%"),
        ("force N: ours, MuJoCo", "force_n", ".3f"),
        ("apart, allowed", lambda row: (row["force_apart_n"], sum(row["force_errors_n"])), ".4f"),
        ("turn deg: ours, MuJoCo", "turn_deg", ".4f"),
        ("apart, allowed", lambda row: (row["turn_apart_deg"], sum(row["turn_errors_deg"])), ".5f"),
        ("", lambda row: "agrees" if row["agree"] else "apart"),
    )


def publish(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write mujoco.json, and the tables between the marks of mujoco.md."""
    write_json(folder / "mujoco.json", rows)
    path, count = folder / "mujoco.md", len(SHALLOW)
    before, *_, after = path.read_text().split(BETWEEN)
    parts = (BETWEEN, mujoco_table(rows[:count]), DEEP_HEAD, mujoco_table(rows[count:]), BETWEEN)
    write_durably(path, f"{before}{page(*parts).rstrip()}{after}".encode())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of mujoco.md, e.g. docs")
    folder: Path = parser.parse_args().out
    rows = []
    for poke in (*SHALLOW, *DEEP):
        comparison = compare(poke)
        rows.append({**asdict(comparison), "agree": comparison.agree})
        print(*mujoco_table(rows[-1:]).cells()[0], sep=", ", flush=True)
    publish(folder, rows)


if __name__ == "__main__":
    main()
