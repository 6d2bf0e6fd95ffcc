"""`python -m simulation robustness`: what disturbances cost the closed loop, on both tiers of the gel, resumable."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from service.contract.shipped import released_models
from simulation.closed_loop import campaign, robustness, statistics
from simulation.closed_loop.baselines import CONTENDERS
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.robustness import CONDITIONS, Condition
from simulation.scene.scene import BUILT_IN, load_scene


@dataclass(frozen=True)
class Options:
    """Play insertions under one disturbance after the other: noise, friction, stiffness, clearance, wear, cameras.

    Results go to OUT/insertions.jsonl as they come, the report to DOCS/robustness.md and .json. All simulated.
    """

    out: Path = Path("runs/robustness")
    """folder for results"""
    docs: Path = Path("runs/robustness")
    """folder for the report"""
    models: Path = field(default_factory=released_models)
    """folder with the ONNX files"""
    objects: tuple[str, ...] = ("rectangle", "hexagon", "white_box")
    """scene names"""
    tiers: tuple[Literal["bristle", "layer"], ...] = ("bristle", "layer")
    """models of the gel; the networks were trained on the bristle tier"""
    only: tuple[str, ...] = ()
    """names of disturbances; all if none is given"""
    who: str = "belief"
    """who decides"""
    count: int = 10
    """insertions an object, disturbance and tier"""
    eyes: Literal["pictures", "gel"] = "pictures"
    """pictures: every frame is drawn, rectified and tracked. gel: slip from the true markers, five times cheaper"""
    seed: int = 7
    """of the start errors, grasps and noise"""
    workers: Annotated[int, tyro.conf.arg(aliases=["-j"])] = 0
    """processes; 0 takes every core"""
    ray: str = ""
    """address of a Ray cluster to work on instead of local processes ("local" starts one on this machine)"""


def tasks(options: Options) -> list[Task]:
    """Everything to play, the n-th insertion of all before the next: a run cut short is still balanced."""
    found = []
    scenes = {name: load_scene(name) for name in options.objects}
    names = options.only or tuple(CONDITIONS)
    for index in range(options.count):
        for tier in options.tiers:
            for name in names:
                for number, (scene, cell) in enumerate(scenes.items()):
                    reach = (cell.x_range_mm, cell.theta_range_deg)
                    # the extremes would weigh too much in a small count
                    x, theta = statistics.start_errors(options.count + 4, options.seed + number, reach)[index + 4]
                    disturbed = CONDITIONS[name]
                    job = {"scene": scene, "index": index, "x_mm": x, "theta_deg": theta, "who": options.who}
                    job |= {"seed": options.seed * 100_000 + index, "eyes": _eyes(options, disturbed)}
                    job |= {"condition": robustness.label(tier, name), "dead": disturbed.dead}
                    job |= {"changes": disturbed.changes(cell) | {"gel.tier": tier}}
                    job["gap_error_mm"] = disturbed.gap_error_mm
                    found.append(Task(options.models / CONTENDERS[options.who].folder, job))
    return found


def _eyes(options: Options, disturbed: Condition) -> str:
    """What shows in pictures alone is only noticed by those who look at them."""
    return "pictures" if disturbed.only_in_pictures else options.eyes


def main(arguments: list[str]) -> int:
    """Run, print the table, write the files."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion robustness")
    for given, known, flag in (
        (options.objects, BUILT_IN, "objects"),
        (options.only, CONDITIONS, "only"),
        ((options.who,), CONTENDERS, "who"),
    ):
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise ValueError(f"--{flag} {', '.join(unknown)}: expected some of {', '.join(known)}")
    if options.count < 1:
        raise ValueError(f"--count {options.count}: expected at least 1")
    if not options.objects or not options.tiers:
        raise ValueError("nothing to play: expected some --objects and --tiers")
    if not list(options.models.glob("*.onnx")):
        raise ValueError(f"--models {options.models}: no *.onnx there; expected the folder with the networks")
    setup = campaign.fingerprint({options.who: options.models / CONTENDERS[options.who].folder})
    campaign.claim(options.out, setup)
    log = options.out / "insertions.jsonl"
    rows = campaign.run(tasks(options), log, workers=options.workers, ray=options.ray)
    sys.stdout.write(robustness.write(rows, setup, options.docs))
    return 0
