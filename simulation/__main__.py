"""`python -m simulation COMMAND`: a table of commands, each imported only when it is called."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("simulation.cell.run:main", "the whole loop: cell, service and robot client insert an object in real time"),
    "cell": ("simulation.cli.cell:main", "the cell in real time on loopback: robot, gripper, cameras, truth"),
    "evaluate": ("simulation.cli.evaluate:main", "the paper's test protocol in lock step: table, scatter, JSON"),
    "robustness": (
        "simulation.cli.robustness:main",
        "what disturbances cost the closed loop: noise, friction, cameras",
    ),
    "explain": ("simulation.cli.explain:main", "which effects a scene calls for, why, and what each costs"),
    "probe": ("simulation.cli.probe:main", "one descent, printed or saved as a picture or video"),
    "collect": ("simulation.data.collect:main", "poke on all cores and keep the collisions as a dataset"),
    "view": ("simulation.data.view:main", "trials of a dataset as pictures"),
    "imprint": ("simulation.studies.imprint:main", "what the simulated sensor sees, object by object, as one picture"),
    "export-dataset": ("simulation.data.export:main", "trials as a LeRobot v3.0 dataset or as MCAP files"),
    "slip-report": (
        "simulation.studies.slip.detection:main",
        "how well slip is detected, and the cost: table, JSON, plot",
    ),
    "trackers": (
        "simulation.studies.slip.tracker_costs:main",
        "accuracy of marker tracking against time: table, JSON, plot",
    ),
    "stop-report": (
        "simulation.studies.stop_latency:main",
        "how soon the arm stops for slip, through the whole live loop: table",
    ),
    "hard-probes": ("simulation.cli.hard_probes:main", "10,000 random nasty contacts: solved, lost or refused by name"),
    "theory": (
        "simulation.studies.theory:main",
        "errors beside Hertz, Mindlin, Winkler and the paper: table",
    ),
    "accuracy": ("simulation.studies.accuracy:main", "what physics accuracy costs in time: table, JSON, plot"),
}


def usage() -> str:
    """One line a command."""
    lines = ["usage: python -m simulation COMMAND [--help]", ""]
    return "\n".join(lines + [f"  {name:<14} {text}" for name, (_, text) in COMMANDS.items()])


def _refuse_negative_seed(words: list[str]) -> None:
    """Every command that draws takes --seed; numpy's own refusal names no option."""
    for word, value in zip(["", *words], [*words, ""], strict=True):
        seed = value.removeprefix("--seed=") if value.startswith("--seed=") else value if word == "--seed" else ""
        if re.fullmatch(r"-\d+", seed):
            raise ValueError(f"--seed {seed}: expected 0 or more")


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Exit status 2 with one line when the input was wrong."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in {"-h", "--help"}:
        print(usage())
        return 0 if arguments else 2
    name, rest = arguments[0], arguments[1:]
    if name not in COMMANDS:
        print(f"no command {name!r}: expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    module, function = COMMANDS[name][0].split(":")
    run: Callable[[list[str]], int] = getattr(importlib.import_module(module), function)
    try:
        _refuse_negative_seed(rest)
        return run(rest)
    except (ValueError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
