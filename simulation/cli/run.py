"""Commands that run the cell with service and robot client around it; they only start processes."""

import contextlib
import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro

from service.contract.text import fitted
from simulation.cell import film, run_report
from simulation.cell.children import ChildError, terminate_as_interrupt
from simulation.cell.demo import DemoOptions, lines
from simulation.cell.options import warn_of_keys_without_effect
from simulation.cell.run import LiveOptions, RunOptions, Start, insert, scene_of, start_of
from simulation.cell.run_report import Result


@dataclass(frozen=True)
class RunCommand(RunOptions):
    """Options that only the command line has."""

    json: bool = False
    """Print the result as JSON, in a list, all other output to standard error."""


def run(arguments: list[str]) -> int:
    """Run the whole loop: exit 0 if the insertion succeeded, 1 if it did not, 2 on invalid input."""
    options = tyro.cli(RunCommand, args=arguments, prog="tactile-insertion run", description=run.__doc__)
    start = start_of(options)
    warn_of_keys_without_effect(options.world, options.object)

    def work() -> int:
        with contextlib.redirect_stdout(sys.stderr) if options.json else contextlib.nullcontext():
            result = _insert(start, options)
        if options.json:
            print(json.dumps([asdict(result)]))
        return 0 if result.inserted else 1

    return exit_status("run", work)


def demo(arguments: list[str]) -> int:
    """Insert one object after another until Ctrl-C, with the page; exit 1 if a process failed."""
    options = tyro.cli(DemoOptions, args=arguments, prog="tactile-insertion demo", description=demo.__doc__)
    options.check()
    warn_of_keys_without_effect(options.world, options.object)
    folder = _folder(options)

    def work() -> int:
        for line in lines(options, folder):
            print(line, flush=True)
        return 0

    return exit_status("demo", work)


def exit_status(command: str, work: Callable[[], int]) -> int:
    """Exit status of work in child processes: 2 if a child refused its input, 1 if it failed, 130 on SIGINT."""
    terminate_as_interrupt()
    try:
        return work()
    except ChildError as error:
        print(f"{command}: {error}", file=sys.stderr)
        return 2 if error.code == 2 else 1
    except KeyboardInterrupt:
        print(f"{command}: interrupted, everything stopped", file=sys.stderr)
        return 130


def _insert(start: Start, options: RunOptions) -> Result:
    folder = _folder(options)
    result = insert(start, options, folder)
    recording = run_report.telling_recording(folder / "recordings")
    drawn = run_report.draw_last_attempt(recording, folder / "last_attempt.png", result) if recording else None
    filmed = film.draw(folder / "cell" / "course.npz", folder / "insertion.gif", scene_of(options).sensor)
    (folder / "result.json").write_text(result.as_json() + "\n")
    lines = map(fitted, run_report.screen(result, recording, drawn, folder, filmed))
    print("", *lines, "", sep="\n", flush=True)
    return result


def _folder(options: LiveOptions) -> Path:
    stem = f"{time.strftime('%Y%m%d-%H%M%S')}-{Path(options.object).stem}-{options.seed}"
    folder, k = options.out / stem, 1
    while folder.exists():
        folder, k = options.out / f"{stem}-{k}", k + 1
    return folder
