"""`python -m tests.hard_cases`: every hard case on three seeds as one table on screen, in docs/ and as JSON.

`python -m tests.hard_cases mutate` removes guards, one at a time, and shows that a case fails for each.
"""

import argparse
import json
import multiprocessing
import multiprocessing.pool
import os
import sys
import time
from pathlib import Path

from rich.progress import track

from reporting.page import page, publish
from reporting.table import Table, table
from tests.hard_cases.mutants import MUTANTS, bitten
from tests.hard_cases.registry import ROOT, SEEDS, Result
from tests.hard_cases.suite import CASES, by_name

NAME = "hard_cases"


def main() -> int:
    """0 if every case held (or every mutant was caught), 1 if not, 2 on wrong arguments."""
    parser = argparse.ArgumentParser(prog="python -m tests.hard_cases", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("what", nargs="?", choices=("cases", "mutate"), default="cases")
    parser.add_argument("--out", type=Path, default=ROOT / "docs", help="folder of the page and the JSON (docs/)")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    workers = multiprocessing.get_context("spawn").Pool(os.cpu_count())
    with workers as pool:
        if options.what == "mutate":
            return mutate(pool, options.out)
        began = time.perf_counter()
        names = sorted(CASES, key=lambda name: (CASES[name].quick, name))  # the long ones first
        measured = track(pool.imap_unordered(by_name, names), description="hard cases", total=len(names))
        results = [Result(CASES[name], *rest) for name, *rest in measured]
    order = list(CASES)
    results.sort(key=lambda result: order.index(result.case.name))
    seconds = time.perf_counter() - began
    show(results, seconds)
    write(results, seconds, options.out)
    return 0 if all(result.passed for result in results) else 1


def show(results: list[Result], seconds: float) -> None:
    """The table on screen."""
    cases = table(
        results,
        ("case", "case.name"),
        ("room", "case.room"),
        ("worst", "worst", ".2g"),
        ("limit", "case.limit", "g"),
        ("", lambda result: "pass" if result.passed else f"FAIL {result.error}"),
        ("what must hold", "case.holds"),
    )
    failed = sum(not result.passed for result in results)
    print(f"{cases.text()}\n{len(results)} cases, seeds {SEEDS}, {failed} failed, {seconds:.0f} s")


def write(results: list[Result], seconds: float, out: Path) -> None:
    """docs/hard_cases.md and .json; the rows of the last `mutate` are kept."""
    rows = [
        {
            "case": r.case.name,
            "room": r.case.room,
            "why": r.case.why,
            "holds": r.case.holds,
            "guard": r.case.guard.symbol,
            "worst": r.worst if r.worst == r.worst else None,
            "limit": r.case.limit,
            "note": r.note,
            "error": r.error,
            "passed": r.passed,
            "seconds": round(r.seconds, 2),
        }
        for r in results
    ]
    report = {"seeds": SEEDS, "seconds": round(seconds), "cases": rows, "mutants": load(out)["mutants"]}
    publish(out, NAME, hard_cases_page(report), report)


def hard_cases_page(report: dict) -> str:
    """The Markdown page of a report."""
    cases, mutants = report["cases"], report["mutants"]
    parts: list[str | Table] = [
        f"""
        # Hard cases

        {sum(not row["passed"] for row in cases)} of {len(cases)} cases failed. Each row states why the case is hard,
        what must hold and what is measured, the worst value over seeds {", ".join(map(str, report["seeds"]))}, its
        limit and the guard in the code that handles the case. `make hard-cases` wrote this page in
        {report["seconds"]} s.
        """
    ]
    for room in dict.fromkeys(row["room"] for row in cases):
        parts += [f"## {room.capitalize()}", _cases([row for row in cases if row["room"] == room])]
    bite = """
        ## Does each guard matter?

        `python -m tests.hard_cases mutate` removes one guard in a fresh process. The case of the guard must then fail.
        """
    columns = ("case that fails", "case"), ("result", lambda row: "caught" if row["caught"] else "**MISSED**")
    guards = table(mutants, ("guard", lambda row: f"`{row['guard']}`"), ("without it", "without"), *columns)
    return page(*parts, bite, guards)


def _cases(rows: list[dict]) -> Table:
    return table(
        rows,
        ("case", "case"),
        ("why it is hard", "why"),
        ("what must hold: measured", lambda row: row["holds"] + (f" ({row['note']})" if row["note"] else "")),
        ("worst", "worst", ".2g"),
        ("limit", "limit", "g"),
        ("guard", lambda row: f"`{row['guard']}`"),
        ("result", lambda row: "pass" if row["passed"] else f"**FAIL** {row['error']}"),
    )


def load(out: Path) -> dict:
    """The report of the last run, or an empty one."""
    path = out / f"{NAME}.json"
    return json.loads(path.read_text()) if path.exists() else {"seeds": SEEDS, "seconds": 0, "cases": [], "mutants": []}


def mutate(pool: multiprocessing.pool.Pool, out: Path) -> int:
    """Every mutant, printed and kept in the report."""
    rows = []
    for name, caught in zip(MUTANTS, track(pool.imap(bitten, MUTANTS), "mutants", len(MUTANTS)), strict=True):
        guard = CASES[name].guard
        rows.append({"case": name, "guard": guard.symbol, "without": guard.without, "caught": caught})
        print(f"{'caught' if caught else 'MISSED'}  {name}: {guard.symbol}")
    report = load(out) | {"mutants": rows}
    publish(out, NAME, hard_cases_page(report), report)
    return 0 if all(row["caught"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
