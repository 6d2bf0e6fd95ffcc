"""`python -m simulation evaluate`: the paper's test protocol on all cores, resumable, as a table beside the paper's."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.progress import track

from simulation import evaluation
from simulation.evaluation import OBJECTS, Row


@dataclass(frozen=True)
class Options:
    """Play insertions in lock step through the real service session, client state machine and ONNX files.

    Results go to OUT/insertions.jsonl as they come (a second call goes on where the first stopped), then
    OUT/summary.json, OUT/table.md and OUT/trials.png. All figures are simulated.
    """

    out: Path = Path("runs/evaluation")
    """folder for results"""
    models: Path = Path("models")
    """folder with the ONNX files to judge"""
    objects: tuple[str, ...] = OBJECTS
    """scene names"""
    count: int = 30
    """insertions an object: the 4 extremes and uniform random errors"""
    controller: Literal["belief", "heuristic"] = "belief"
    """who decides"""
    baseline: Literal["none", "oracle"] = "none"
    """put this in the controller's place: oracle moves by the true error"""
    seed: int = 0
    """of the start errors, grasps and noise"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 takes every core"""


def _jobs(options: Options, done: set[str]) -> list[dict[str, object]]:
    jobs = []
    for number, scene in enumerate(options.objects):
        for index, (x, theta) in enumerate(evaluation.start_errors(options.count, options.seed + number)):
            seed = options.seed * 100_000 + index
            job = {"scene": scene, "index": index, "x_mm": x, "theta_deg": theta, "seed": seed}
            job |= {"controller": options.controller, "baseline": options.baseline}
            if _key(job) not in done:
                jobs.append(job)
    return jobs


def _key(row: dict[str, object]) -> str:
    return "/".join(str(row[name]) for name in ("scene", "controller", "baseline", "seed", "index"))


_MODELS: dict[Path, object] = {}


def _play(work: tuple[Path, dict[str, object]]) -> Row:
    """In a worker: load the models once, then play jobs."""
    from service.models import load_models
    from simulation.evaluate import Job, insert

    folder, fields = work
    if folder not in _MODELS:
        _MODELS[folder] = load_models(folder)
    outcome = insert(Job(**fields), _MODELS[folder])  # type: ignore[arg-type]
    return fields | dataclasses.asdict(outcome)


def _read(path: Path) -> list[Row]:
    """What an earlier call finished; a last line cut short by a kill is dropped."""
    rows = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def _results(options: Options, jobs: list[dict[str, object]]) -> Iterator[Row]:
    workers = options.workers or os.cpu_count() or 1
    work = [(options.models, job) for job in jobs]
    if workers == 1:
        yield from map(_play, work)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(_play, work)


def main(arguments: list[str]) -> int:
    """Run, print the table, write the files; 0 also when insertions failed: the table says so."""
    options = tyro.cli(Options, args=arguments, prog="python -m simulation evaluate")
    unknown = sorted(set(options.objects) - set(OBJECTS))
    if unknown:
        raise ValueError(f"--objects {', '.join(unknown)}: expected some of {', '.join(OBJECTS)}")
    if not options.models.is_dir():
        raise ValueError(f"--models {options.models}: no such folder; expected the one with the *.onnx files")
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "insertions.jsonl"
    rows = _read(log)
    jobs = _jobs(options, {_key(row) for row in rows})
    with log.open("a") as file:
        for row in track(_results(options, jobs), description="insertions (simulated)", total=len(jobs)):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    summaries = evaluation.summarise(rows)
    text = evaluation.table(summaries)
    (options.out / "summary.json").write_text(json.dumps(summaries, indent=1))
    (options.out / "table.md").write_text(text + "\n")
    evaluation.draw_scatter(rows, options.out / "trials.png")
    sys.stdout.write(text + "\n")
    return 0
