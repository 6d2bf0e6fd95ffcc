"""`python -m tests.mutants`: random small changes of the code that decides; the fast tests of its room must fail.

Each mutant runs in a copy of the repository against the tests in the folder that mirrors its own. Survivors go into
docs/mutants.json and .md; what a person wrote there about a survivor ("judged") is kept as long as it survives.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from reporting.page import page, publish
from reporting.statistics import wilson
from reporting.table import table
from tests.mutants.change import Mutant, changes, mutant

ROOT = Path(__file__).parents[2]
ROOMS = (
    "service/decision", "service/perception/slip", "service/session",
    "robot_client/insertion", "robot_client/robots", "robot_client/grippers",
)  # fmt: skip
NAME, UNJUDGED = "mutants", "not judged yet"
QUIET = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def drawn(count: int, seed: int) -> list[Mutant]:
    """``count`` mutants, each change of each module as likely as any other."""
    paths = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py")) if not path.stem.endswith("_pb2")]
    places = [(path, number) for path in paths for number, _ in enumerate(changes(ast.parse(path.read_text())))]
    return [mutant(ROOT, *place) for place in random.Random(seed).sample(places, min(count, len(places)))]


def room_of(module: str) -> str:
    """The folder of tests that mirrors the module's, or the nearest one above that exists."""
    folders = [Path("tests", folder) for folder in Path(module).parents]
    return str(next(folder for folder in folders if (ROOT / folder).is_dir()))


def failure(copy: Path, tests: list[str], timeout_s: float) -> str:
    """The first of the tests that fails in this copy of the repository; empty if all of them pass."""
    command = [sys.executable, "-m", "pytest", "-x", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env=os.environ | QUIET,
            capture_output=True,
            check=False,
            timeout=timeout_s,
            text=True,
            start_new_session=True,  # a mutant may stop or kill its process group
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED tests/", "ERROR tests/"))]
    return (
        lines[0].split(" - ")[0].split(" ", 1)[1] if lines else f"exit code {done.returncode}" * bool(done.returncode)
    )


def killer(change: Mutant, copy: Path, timeout_s: float) -> str:
    """The test that fails with the mutant and passes without it; empty if there is none."""
    path, flaky = Path(change.module), list[str]()
    folder = room_of(change.module)
    own = [str(name) for name in [Path(folder, f"test_{path.stem}.py")] if (copy / name).exists()]  # the quickest way
    while True:
        (copy / path).write_text(change.source)
        failed = failure(copy, [*own, folder, *(f"--deselect={test}" for test in flaky)], timeout_s)
        shutil.copyfile(ROOT / path, copy / path)
        if "tests/" not in failed or not failure(copy, [failed], timeout_s):
            return failed
        flaky.append(failed)


def copied(target: Path) -> Path:
    """The tracked files, as they are in the working tree, in a new folder."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True)
    for name in tracked.stdout.split("\0")[:-1]:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, target / name)
    return target


def tried(chosen: list[Mutant], workers: int, timeout_s: float) -> list[Mutant]:
    """The mutants that survive."""
    copies: Queue[Path] = Queue()

    def attempt(change: Mutant) -> str:
        copy = copies.get()
        try:
            return killer(change, copy, timeout_s)
        finally:
            copies.put(copy)

    survivors = []
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(workers) as pool:
        for worker in range(workers):
            copies.put(copied(Path(scratch, str(worker))))
        for change, failed in zip(chosen, pool.map(attempt, chosen), strict=True):
            outcome = f"killed by {failed}" if failed else "SURVIVED"
            print(f"{change.module}:{change.line}: {change.before} -> {change.after}: {outcome}", flush=True)
            survivors += [] if failed else [change]
    return survivors


def mutants_page(report: dict) -> str:
    """The Markdown page of a report."""
    opening = f"""
        # Mutants

        Written by `make mutants`: {report["count"]} random small changes (seed {report["seed"]}) of the modules that
        decide, claim, detect slip and move, each against the fast tests of its own room alone. Killed:
        {report["killed"]} of {report["count"]}, {wilson(report["killed"], report["count"]):.1%} with the 95 %
        interval of Wilson. These survived:
        """
    change = ("change", lambda row: f"`{row['before']}` -> `{row['after']}`")
    place = ("where", lambda row: f"`{row['module']}:{row['line']}`")
    return page(opening, table(report["survivors"], place, change, ("what it shows", "judged")))


def main() -> int:
    """0 once the mutants were tried, whatever survived; 2 on wrong arguments."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="mutants to draw (200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="mutants tried at a time (2)")
    parser.add_argument("--timeout-s", type=float, default=900, help="for the tests of a room (900)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the page and the JSON (docs/)")
    options = parser.parse_args()
    chosen = drawn(options.count, options.seed)
    survivors = [change._asdict() for change in tried(chosen, options.workers, options.timeout_s)]
    path = options.out / f"{NAME}.json"
    known = json.loads(path.read_text())["survivors"] if path.exists() else []
    known_as = {(row["module"], row["before"], row["after"]): row["judged"] for row in known}
    for row in survivors:
        del row["source"]
        row["judged"] = known_as.get((row["module"], row["before"], row["after"]), UNJUDGED)
    killed = len(chosen) - len(survivors)
    report = {"seed": options.seed, "count": len(chosen), "killed": killed, "survivors": survivors}
    publish(options.out, NAME, mutants_page(report), report)
    print(f"{killed} of {len(chosen)} killed, {wilson(killed, len(chosen)):.1%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
