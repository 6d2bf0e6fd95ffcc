"""A cell that learns, in lock step: its probes and its work are stored as recordings, from which it adapts.

The software is not given the world. Adapting is training's own command in a separate process, as on a cell's PC.
"""

import hashlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, cycle, islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from reporting.files import write_json
from robot_client.session.commission.run import FITS, PER_GRASP, REACH, errors
from robot_client.session.commission.wiring import SIDES
from service.contract import ContractError
from simulation.closed_loop import benchmark
from simulation.closed_loop.job import job_in
from simulation.closed_loop.lockstep import hash_seed
from simulation.closed_loop.statistics import Row, ends
from simulation.data.manifest import MANIFEST, read_manifest
from simulation.data.parallel import results
from simulation.data.progress import shown
from simulation.data.sources import sources_sha256
from simulation.scene import drawn
from simulation.scene.scene import Scene
from simulation.scene.worlds import World
from simulation.studies.episodes import Episode, play
from simulation.studies.lateness import timed
from simulation.studies.pace.points import client, with_care
from simulation.studies.wiring import by_corner, carried_out, named_mistakes, probes, touched

COUNTED = (
    *("direction_right", "direction_n", "mae_x_mm", "mae_theta_deg", "covered_x", "covered_theta"),
    *("mean_trials", "inserted", "insertions", "claimed_wrongly"),
)
AFTER_WORK = "after_work"
VERSIONS = ("released", "after_50", "after_150", AFTER_WORK)
PROBES, WORK, SCORING, TIMING = 1, 2, 3, 5  # 4: `wiring.SIGNS`
FEW = 50
REFUSED, STAYS = 2, 3
"""Exit statuses of `training adapt`: invalid input, such as nothing to learn from, and a release that stays."""
LEARNT_BY = "training.adapt.adapt", "export.onnx.to_onnx"
ANSWERS: Mapping[str, set[int]] = {"simulation": {0, REFUSED}, "training": {0, REFUSED, STAYS}, "export": {0, REFUSED}}
"""Exit statuses that are an answer, of each package's command."""


@dataclass(frozen=True)
class Cell:
    """A world with the objects it packs, and the folder of everything learnt from it."""

    world: World
    objects: Mapping[str, Scene]
    folder: Path
    seed: int
    cell: str = ""
    late_s: float | None = None  # of pictures and arm, once it is measured

    def jobs(self, count: int, purpose: int) -> list[Row]:
        """``count`` starts, object after object, drawn separately for each purpose."""
        names = list(islice(cycle(self.objects), count))
        ranges = [(self.objects[name].x_range_mm, self.objects[name].theta_range_deg) for name in names]
        shares = np.random.default_rng((self.seed, purpose)).uniform(-1.0, 1.0, (count, 2))
        return self._jobs(names, shares * ranges, purpose)

    def probes(self, count: int) -> list[Row]:
        """Jobs of ``count`` known errors, drawn like the client's: several with one grasp, an object in each in turn.

        With those of the signs, the first grasps hold FEW.
        """
        few = min(count, FEW - len(SIDES))
        firsts = [*range(0, few, PER_GRASP), *range(few, count, PER_GRASP)]
        names, starts = list(islice(cycle(self.objects), len(firsts))), []
        for name, first, end in zip(names, firsts, [*firsts, count][1:], strict=True):
            scene = self.objects[name]
            within = min(REACH[0], scene.x_range_mm), min(REACH[1], scene.theta_range_deg)
            starts.append(list(map(errors(self.seed, *within, FITS), range(first, end))))
        jobs = self._jobs(names, [several[0] for several in starts], PROBES)
        more = [{"purpose": "probe", "starts": several[1:]} for several in starts]
        return [{**job, **asked} for job, asked in zip(jobs, more, strict=True)]

    def signs(self) -> Iterator[list[Row]]:
        """The four probes of the wiring check with each object, the one that tells the yaw best first."""
        for name in by_corner(self.objects):
            yield probes(self.world, name, self.seed, **self._asked(name))

    def _jobs(self, names: Sequence[str], starts: ArrayLike, purpose: int) -> list[Row]:
        rows = []
        for index, (name, (x_mm, theta_deg)) in enumerate(zip(names, np.asarray(starts, float), strict=True)):
            seed = hash_seed(self.seed, purpose, index)
            rows.append(job_in(self.world, name, index, (x_mm, theta_deg), seed, **self._asked(name)))
        return rows

    def _asked(self, name: str) -> Row:
        given = with_care(client(), self.world, name, self.late_s)
        return {"cell": self.cell, "client": given, "late_s": self.late_s}


@dataclass(frozen=True)
class Plan:
    """How much a cell learns from and is evaluated on; ``checkpoint``: the release to adapt.

    The wiring check's four are the first of the ``probes``. With 0 ``probes`` only the wiring check is run; with 0
    ``work`` nothing is learnt from work; with 0 ``around`` nothing from presses simulated around the known parameters
    of the cell.
    """

    checkpoint: Path
    models: Path
    probes: int
    insertions: int
    workers: int = 0
    work: int = 0
    around: int = 0


def commission(cell: Cell, plan: Plan) -> Row:
    """Probe, adapt and work in one cell; returns its row, see ``python -m simulation commission --help``.

    A cell with a mistake stops there: no version is played, and all its counts are 0. ``wired_right``: whether it has
    none in truth. ``late``: what presses at two speeds tell; everything after them reckons with it. Where they tell
    nothing, a client refuses to insert; this one is played with the lateness that the client assumes.
    """
    signs, folder = _asked_for_signs(cell, plan)
    labelled = {folder / f"{index:05d}": 1 for index in range(len(signs))}
    row: Row = {"world": cell.world.name, "wired_right": cell.world.unstated.wired_right}
    row |= {"mistakes_named": named_mistakes(signs), "signs_told": carried_out(signs)}
    if row["mistakes_named"] or not plan.probes:
        row |= {name: {**dict.fromkeys(COUNTED, 0), **dict.fromkeys(COUNTED[2:7])} for name in VERSIONS}
        return {**row, "robot_minutes": _minutes(signs), "adapt_s": 0.0, "accepted": False, "verdicts": {}}
    name = next(iter(by_corner(cell.objects)))
    row["late"] = timed(cell.world, name, hash_seed(cell.seed, TIMING), plan.models, cell=cell.cell)
    cell = replace(cell, late_s=row["late"]["late_s"])
    probes = _played(cell, plan, "probes", cell.probes(max(0, plan.probes - len(signs))), in_order=True)
    labelled |= {cell.folder / "probes" / f"{index:05d}": 1 + len(row["starts"]) for index, row in enumerate(probes)}
    if plan.work:
        _played(cell, plan, "work", cell.jobs(plan.work, WORK))
    around, around_s = _pressed_around(cell, plan) if plan.around else (None, 0.0)
    row["released"] = _scored(cell, plan, "released", plan.models)
    outcomes = {}
    for name, episodes in _lessons(cell, plan, labelled).items():
        outcomes[name], models = _adapted(cell, plan, name, episodes, around)
        row[name] = row["released"] if models is None else _scored(cell, plan, models.parent.name, models)
    return {
        "after_150": row["after_50"],
        "after_work": row["released"],
        **row,
        "robot_minutes": _minutes([*signs, *probes, row["late"]]),
        "adapt_s": around_s + max(outcome["took_s"] for outcome in outcomes.values()),
        "accepted": outcomes.get("after_150", outcomes["after_50"])["accepted"],
        "verdicts": outcomes,
    }


def _asked_for_signs(cell: Cell, plan: Plan) -> tuple[list[Row], Path]:
    """The wiring check's four probes, and their folder: with the first object that touches something.

    Where none does, those of the first object with which they were carried out, if there is one.
    """
    signs, folder = list[Row](), cell.folder
    for number, jobs in enumerate(cell.signs(), 1):
        name = f"signs-{number}"
        rows = _played(cell, plan, name, jobs, in_order=True)
        if not signs or touched(rows) or not carried_out(signs):
            signs, folder = rows, cell.folder / name
        if touched(rows):
            break
    return signs, folder


def _lessons(cell: Cell, plan: Plan, labelled: Mapping[Path, int]) -> dict[str, Sequence[Path]]:
    """The episodes that each version learns from.

    ``labelled``: those of known error, the wiring check's first, with the number of their probes.
    """
    made = zip(labelled, accumulate(labelled.values()), strict=True)
    lessons: dict[str, Sequence[Path]] = {"after_50": [episode for episode, made_n in made if made_n <= FEW]}
    if sum(labelled.values()) > FEW:
        lessons["after_150"] = list(labelled)
    if plan.work:
        lessons[AFTER_WORK] = [cell.folder / "work" / f"{index:05d}" for index in range(plan.work)]
    return lessons


def _pressed_around(cell: Cell, plan: Plan) -> tuple[Path | None, float]:
    """Press the cell's objects in simulated cells with the grip and height given to its client; the folder, seconds.

    A grip or height that differs from object to object is drawn. No folder if an object cannot be pressed there: it
    always goes in, or falls from the hand.
    """
    grasps, error_mm = [scene.grasp for scene in cell.objects.values()], cell.world.unstated.told_height_error_mm
    stated = {"force_n": {one.force_n for one in grasps}, "height_mm": {one.height_mm + error_mm for one in grasps}}
    shared = {key: values.pop() for key, values in stated.items() if len(values) == 1}
    tables: drawn.Tables = {"grasp": shared, "gel": {"tier": "bristle"}}
    pressed_by = sources_sha256("simulation.data.collect")
    which = [pressed_by, plan.around, tables, {name: scene.sha256 for name, scene in cell.objects.items()}]
    out = cell.folder / f"around-{_digest(json.dumps(which).encode())}"
    kept, known = out.with_suffix(".json"), out.with_suffix(".toml")
    if not kept.exists():
        began = time.monotonic()
        known.parent.mkdir(parents=True, exist_ok=True)
        known.write_text(drawn.toml(tables, "what the client is given, of the tier that costs least"), encoding="utf-8")
        each = str(-(-plan.around // len(cell.objects)))
        where = ("--around", str(known), "--out", str(out), "--objects", *cell.objects)
        more = ("--trials-per-object", each, "--seed", str(cell.seed), "--workers", str(plan.workers))
        refused = _call("simulation", "collect", *where, *more)
        if not ((out / MANIFEST).exists() and read_manifest(out).complete):
            print(f"{cell.world.name}: nothing is learnt from presses around the cell: {refused}", file=sys.stderr)
            return None, time.monotonic() - began
        write_json(kept, {"took_s": time.monotonic() - began})
    return out, float(json.loads(kept.read_text(encoding="utf-8"))["took_s"])


def _minutes(rows: Sequence[Row]) -> float:
    return sum(float(row["robot_s"]) for row in rows) / 60.0


def _played(
    cell: Cell,
    plan: Plan,
    name: str,
    jobs: Sequence[Row],
    *,
    models: Path | None = None,
    in_order: bool = False,
) -> list[Row]:
    folder = cell.folder / name
    episodes = [Episode(folder / f"{index:05d}", models or plan.models, job) for index, job in enumerate(jobs)]
    rows = results(play, episodes, plan.workers, in_order=in_order)
    return list(shown(f"{cell.world.name}: {name} (simulated)", rows, len(episodes)))


def _scored(cell: Cell, plan: Plan, name: str, models: Path) -> Row:
    """The same fresh starts for every version of the networks."""
    jobs = cell.jobs(plan.insertions, SCORING)
    rows = _played(cell, plan, f"judged-{name}", jobs, models=models)
    counted = {**ends(rows), **benchmark.first_answers(rows)}
    return {key: counted[key] for key in COUNTED}


def _adapted(
    cell: Cell, plan: Plan, name: str, episodes: Sequence[Path], around: Path | None
) -> tuple[Row, Path | None]:
    """The verdict of ``training adapt`` on these episodes, and the new networks' folder if accepted.

    It is kept for exactly what it was made from: release, episodes, presses ``around`` the cell, and the code.
    """
    made_from = [plan.checkpoint.read_bytes(), *((episode / "summary.json").read_bytes() for episode in episodes)]
    made_from += [sources_sha256(module).encode() for module in LEARNT_BY]
    run = cell.folder / f"{name}-{_digest(*made_from, str(around and around.name).encode())}"
    shown = run.with_name(f"{run.name}-episodes")
    kept, models, began = run / "verdict.json", run / "models", time.monotonic()
    if not kept.exists():
        shutil.rmtree(shown, ignore_errors=True)
        shutil.rmtree(run, ignore_errors=True)
        shown.mkdir(parents=True)
        run.mkdir(parents=True)
        for index, episode in enumerate(episodes):
            (shown / f"{index:05d}").symlink_to(episode.resolve())
        answer = run / "told.json"
        words = [str(shown), "--from", str(plan.checkpoint), "--out", str(run), "--json", str(answer)]
        words += ["--around", str(around)] if around else []
        refused = _call("training", "adapt", *words)
        outcome: Row = {"accepted": False, "best": "released", "objections": [refused], "samples_n": 0}
        if answer.exists():
            outcome = json.loads(answer.read_text(encoding="utf-8"))
        if outcome["accepted"]:
            refused = _call("export", "onnx", str(run / "checkpoint.pt"), "--out", str(models))
            if not list(models.glob("*.step.onnx")):
                outcome |= {"accepted": False, "objections": [f"not exported: {refused}"]}
        write_json(kept, {**outcome, "took_s": time.monotonic() - began})
    outcome = json.loads(kept.read_text(encoding="utf-8"))
    return outcome, models if outcome["accepted"] else None


def _digest(*parts: bytes) -> str:
    """A short name for contents."""
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts)).hexdigest()[:12]


def _call(package: str, *words: str) -> str:
    """Call a command and return its output. Raises ContractError if it gave no answer."""
    done = subprocess.run([sys.executable, "-m", package, *words], capture_output=True, text=True, check=False)
    text = done.stderr.strip() or done.stdout.strip()
    if done.returncode not in ANSWERS[package]:
        raise ContractError(f"python -m {package} {words[0]}: exit status {done.returncode}: {text[-2000:]}")
    return text
