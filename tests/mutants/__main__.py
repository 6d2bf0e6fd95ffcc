"""`python -m tests.mutants`: random small changes of the code that decides; the fast tests of its room must fail.

Each mutant runs in a copy of the repository against the tests in the folder that mirrors its own: those named after its
module first, then those that import it, up to the first that fails. Survivors go into
docs/mutants.json and .md; what a person wrote there about a survivor ("judged") is kept as long as it survives.
"""

import argparse
import ast
import json
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from reporting.machine import commit
from reporting.page import page, publish
from reporting.statistics import wilson
from reporting.table import table
from tests.mutants.change import Mutant, changes, mutant
from tests.mutants.forked import Copy

ROOT = Path(__file__).parents[2]
ROOMS = (
    "service/decision", "service/perception", "service/session",
    "robot_client/insertion", "robot_client/robots", "robot_client/grippers",
)  # fmt: skip
NAME, UNJUDGED = "mutants", "not judged yet"
NO_SUCH_TEST = "exit code 4"  # pytest's; its name has changed with the mutant, and it cannot fail without it


def drawn(count: int, seed: int) -> list[Mutant]:
    """``count`` mutants, each change of each module as likely as any other."""
    paths = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py")) if not path.stem.endswith("_pb2")]
    places = [(path, number) for path in paths for number, _ in enumerate(changes(ast.parse(path.read_text())))]
    return [mutant(ROOT, *place) for place in random.Random(seed).sample(places, min(count, len(places)))]


def room_of(root: Path, module: str) -> str:
    """The folder of tests that mirrors the module's, or the nearest one above that exists."""
    folders = [Path("tests", folder) for folder in Path(module).parents]
    return str(next(folder for folder in folders if (root / folder).is_dir()))


def nearest_first(root: Path, module: str) -> list[str]:
    """The files of the mirroring folder in ``root``: the module's own tests, those that import it, the others."""
    path = Path(module)

    def distance(file: Path) -> tuple[bool, bool, str]:
        imports = [line for line in file.read_text().splitlines() if line.startswith(("from ", "import "))]
        imported = any(path.parent.name in line and path.stem in line for line in imports)
        return file.name != f"test_{path.stem}.py", not imported, str(file)

    files = sorted((root / room_of(root, module)).rglob("test_*.py"), key=distance)
    return [str(file.relative_to(root)) for file in files]


def killer(change: Mutant, copy: Copy, timeout_s: float, flaky: list[str]) -> str:
    """The first test that fails with the mutant, except for ``flaky`` ones; empty if there is none."""
    changed, files = copy.root / change.module, nearest_first(copy.root, change.module)
    before = changed.read_bytes()
    changed.write_text(change.source)
    failed = copy.failure(change.module, [*files, *(f"--deselect={test}" for test in flaky)], timeout_s)
    changed.write_bytes(before)  # not from the working tree, where a person may go on meanwhile
    return failed


def failing(copy: Copy, tests: set[str], timeout_s: float) -> set[str]:
    """Those of the tests that fail without any mutant, too."""
    left, bad = set(tests), set[str]()
    while left and (failed := copy.failure("", sorted(left), timeout_s)):
        if failed not in left:  # no test failed, as where a mutant has changed the name of one: ask for each
            return bad | {test for test in left if copy.failure("", [test], timeout_s) not in ("", NO_SUCH_TEST)}
        bad.add(failed)
        left.discard(failed)
    return bad


def copied(target: Path) -> Path:
    """The tracked files, as they are in the working tree, in a new folder."""
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True)
    for name in tracked.stdout.split("\0")[:-1]:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target / name)
    return target


def tried(chosen: list[Mutant], workers: int, timeout_s: float, scratch: Path) -> list[Mutant]:
    """The mutants that survive; copies are made in ``scratch``. A test that fails without them kills none."""
    copies, flaky, left, killed_by = Queue[Copy](), list[str](), chosen, dict[Mutant, str]()

    def attempt(change: Mutant) -> str:
        copy = copies.get()
        try:
            return killer(change, copy, timeout_s, flaky)
        finally:
            copies.put(copy)

    with ThreadPoolExecutor(workers) as pool:
        for begun in [Copy(copied(scratch / str(worker))) for worker in range(workers)]:
            copies.put(begun.ready())
        while left:
            for change, failed in zip(left, pool.map(attempt, left), strict=True):
                killed_by[change] = failed
                outcome = f"killed by {failed}" if failed else "SURVIVED"
                print(f"{change.module}:{change.line}: {change.before} -> {change.after}: {outcome}", flush=True)
            copy = copies.get()
            bad = failing(copy, {test for test in killed_by.values() if test.startswith("tests/")}, timeout_s)
            copies.put(copy)
            flaky += bad
            left = [change for change in left if killed_by[change] in bad]
            print("".join(f"fails without a mutant, too: {test}\n" for test in sorted(bad)), end="", flush=True)
        for _ in range(workers):
            copies.get().close()
    return [change for change in chosen if not killed_by[change]]


def mutants_page(report: dict) -> str:
    """The Markdown page of a report."""
    opening = f"""
        # Mutants

        {report["killed"]} of {report["count"]} mutants were killed, {wilson(report["killed"], report["count"]):.1%}
        with the 95 % Wilson interval.

        `make mutants` makes {report["count"]} random small changes (seed {report["seed"]}) to the modules that
        decide, claim, perceive and move, here at commit `{report["commit"][:8]}`. Each mutant runs against
        the fast tests of its own room only. The tests were written before the seed was drawn, with samples of
        other seeds as a guide, so the figure is a fair sample; tests that the survivors suggested came later.

        A mutation replaces a comparison by its opposite, an operator by its inverse, a truth value by the
        other, a whole number by the next one, or a constant by slightly more than one and a half times its
        value. `<` becomes `<=` only between whole numbers: a measured quantity never equals its limit, so
        elsewhere both are the same program. So are all negative sizes in a `reshape`, of which the sign alone
        changes. At least 200 mutants and 90 % were asked for.
        """
    rooms = table(report["rooms"], ("room", "room"), ("changes", "count", "d"), ("killed", "killed", "d"))
    change = ("change", lambda row: f"`{row['before']}` -> `{row['after']}`")
    place = ("where", lambda row: f"`{row['module']}:{row['line']}`")
    survivors = table(report["survivors"], place, change, ("assessment", "judged"))
    return page(opening, rooms, "## Survivors", survivors)


def by_room(chosen: list[Mutant], survivors: list[Mutant]) -> list[dict]:
    """Number of mutants drawn in each package, and number killed."""
    drawn_n, left_n = (Counter(home_of(change) for change in some) for some in (chosen, survivors))
    return [{"room": room, "count": drawn_n[room], "killed": drawn_n[room] - left_n[room]} for room in ROOMS]


def home_of(change: Mutant) -> str:
    return next(room for room in ROOMS if change.module.startswith(f"{room}/"))


def report_of(seed: int, of: str, chosen: list[Mutant], survivors: list[Mutant], known: list[dict]) -> dict:
    """The published data ``of`` a commit; a person's notes about a ``known`` survivor stay."""
    known_as = {(row["module"], row["before"], row["after"]): row["judged"] for row in known}
    rows = []
    for change in survivors:
        row = {key: value for key, value in change._asdict().items() if key != "source"}
        rows.append(row | {"judged": known_as.get((change.module, change.before, change.after), UNJUDGED)})
    count, killed = len(chosen), len(chosen) - len(survivors)
    rooms = by_room(chosen, survivors)
    return {"seed": seed, "commit": of, "count": count, "killed": killed, "rooms": rooms, "survivors": rows}


def main() -> int:
    """0 once the mutants were tried, whatever survived; 2 on wrong arguments."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=200, help="mutants to draw (200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="mutants tried at a time (2)")
    parser.add_argument("--timeout-s", type=float, default=300, help="for the tests of a room (300)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the page and the JSON (docs/)")
    parser.add_argument("--scratch", type=Path, help="folder to keep copies and what they compile in (none)")
    parser.add_argument("--page", action="store_true", help="try nothing: the page of the JSON, once it is judged")
    options = parser.parse_args()
    path = options.out / f"{NAME}.json"
    report = json.loads(path.read_text()) if path.exists() else {"survivors": []}
    if not options.page:
        chosen, of = drawn(options.count, options.seed), commit()
        with tempfile.TemporaryDirectory() as scratch:
            survivors = tried(chosen, options.workers, options.timeout_s, options.scratch or Path(scratch))
        report = report_of(options.seed, of, chosen, survivors, report["survivors"])
    publish(options.out, NAME, mutants_page(report), report)
    killed, count = report["killed"], report["count"]
    print(f"{killed} of {count} killed, {wilson(killed, count):.1%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
