"""`python -m simulation COMMAND`: a table of commands, each imported only when it is called."""

import importlib
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("run:run", "cell, service and robot client insert an object in real time"),
    "demo": ("run:demo", "a simulated cell at work, with its page, until Ctrl-C"),
    "cell": ("cell:cell", "the cell in real time: robot, gripper, cameras, truth"),
    "evaluate": ("evaluate:main", "play every world with every object in lock step: rows, JSON"),
    "drawn-worlds": ("drawn_worlds:main", "drawn worlds with drawn objects in lock step, all variants"),
    "sealed": (
        "drawn_worlds:sealed",
        "the sealed test: worlds drawn from the release's bytes",
    ),
    "commission": ("commission:main", "cells that probe, adapt and learn from work, world by world"),
    "scene": ("commission:scene", "identify a cell's gel from its presses, as a world file"),
    "trust": ("trust:main", "claims under adversity: faults, drawn worlds, objects, starts"),
    "explain": ("explain:explain", "which effects a scene calls for, why, and what each costs"),
    "probe": ("probe:probe", "one descent, printed or saved as a picture or video"),
    "imprint": ("probe:imprint", "what the sensor records, object by object, as one picture"),
    "draw-worlds": ("drawn_worlds:draw_worlds", "drawn worlds outside the training set, as files"),
    "draw-objects": ("drawn_worlds:draw_objects", "random convex objects as files"),
    "collect": ("dataset:collect", "poke on all cores and keep the collisions as a dataset"),
    "export-dataset": ("dataset:export_dataset", "trials as a LeRobot v3.0 dataset"),
    "slip-report": ("slip:slip_report", "how well slip is detected, and the cost: table, JSON"),
    "grasps": ("slip:real_grasps", "recorded grasps of real objects, judged: table run by run"),
    "motion-bounds": ("cell:motion_bounds", "overtravel of the arm after live faults, with bounds"),
    "hard-probes": ("physics:hard_probes", "10,000 random hard contacts: solved, lost or refused by name"),
    "foreign-check": ("physics:foreign_check", "the foreign cell's finite elements beside CalculiX: table, JSON"),
    "pace": ("pace:main", "what the client's settings cost in seconds per box"),
    "choose": ("pace:choose", "the client's settings for a time, success and force, as a file"),
    "accuracy": ("physics:accuracy", "what physics accuracy costs in time: table, JSON, plot"),
}
RESUMED = {"collect", "evaluate", "trust", "pace", "drawn-worlds", "sealed", "motion-bounds", "commission"}


def usage() -> str:
    """One line per command."""
    lines = ["usage: python -m simulation COMMAND [--help]", ""]
    return "\n".join(lines + [f"  {name:<14} {text}" for name, (_, text) in COMMANDS.items()])


def _refuse_negative_seed(words: list[str]) -> None:
    """Refuse a negative --seed by name; every command that draws takes one, and numpy's own error names no option."""
    for word, value in zip(["", *words], [*words, ""], strict=True):
        seed = value.removeprefix("--seed=") if value.startswith("--seed=") else value if word == "--seed" else ""
        if re.fullmatch(r"-\d+", seed):
            raise ValueError(f"--seed {seed}: expected 0 or more")


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Exits with status 2 and one line on invalid input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in {"-h", "--help"}:
        print(usage())
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    for pool in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(pool, "1")  # as in worker processes: with more threads, sums differ in their last bits
    from service.contract.refusals import nearest
    from service.contract.text import run_command
    from simulation import compile_cache
    from simulation.scene.state import PhysicsError

    if name not in COMMANDS:
        print(f"simulation: unknown command {name!r}{nearest(name, COMMANDS)}", file=sys.stderr)
        return 2
    module, function = COMMANDS[name][0].split(":")

    def work() -> int:
        compile_cache.make(Path(__file__).parent)
        run: Callable[[list[str]], int] = getattr(importlib.import_module(f"simulation.cli.{module}"), function)
        _refuse_negative_seed(rest)
        return run(rest)

    refused = (ValueError, OSError, PhysicsError)  # the last for an object that cannot be held
    return run_command(name, work, refused, resumes=name in RESUMED)


if __name__ == "__main__":
    sys.exit(main())
