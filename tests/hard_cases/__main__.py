"""`python -m tests.hard_cases`: every hard case on three seeds as one table, on screen, in docs/ and as JSON.

`python -m tests.hard_cases mutate` takes guards away, one at a time, and shows that a case fails for each.
"""

import argparse
import json
import multiprocessing
import multiprocessing.pool
import os
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import track
from rich.table import Table

from tests.hard_cases.mutants import MUTANTS, bitten
from tests.hard_cases.registry import ROOT, SEEDS, Result
from tests.hard_cases.suite import CASES, by_name

PAGE, FILE = "hard_cases.md", "hard_cases.json"
COLUMNS = ("case", "room", "what must hold", "worst", "limit", "")


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
    table = Table(*COLUMNS, title=f"hard cases, seeds {SEEDS}", row_styles=["", "dim"])
    for result in results:
        verdict = "[green]pass" if result.passed else f"[red]FAIL {result.error}"
        case = result.case
        table.add_row(case.name, case.room, case.holds, f"{result.worst:.2g}", f"{case.limit:g}", verdict)
    console = Console()
    console.print(table)
    failed = sum(not result.passed for result in results)
    console.print(f"{len(results)} cases, {failed} failed, {seconds:.0f} s")


def write(results: list[Result], seconds: float, out: Path) -> None:
    """docs/hard_cases.md and .json; the rows of the last `mutate` are kept."""
    path = out / FILE
    before = json.loads(path.read_text()) if path.exists() else {}
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
    report = {"seeds": SEEDS, "seconds": round(seconds), "cases": rows, "mutants": before.get("mutants", [])}
    path.write_text(json.dumps(report, indent=1) + "\n")
    (out / PAGE).write_text(page(report))


def page(report: dict) -> str:
    """The Markdown page of a report."""
    counted = f"{len(report['cases'])} cases, {sum(not row['passed'] for row in report['cases'])} failed"
    lines = ["# Hard cases", ""]
    lines += [
        "Written by `make hard-cases`: what is nasty, what must hold, how close it came (worst of seeds",
        f"{', '.join(map(str, SEEDS))}), and what answers it. {counted}, {report['seconds']} s.",
    ]
    for room in dict.fromkeys(row["room"] for row in report["cases"]):
        lines += [
            "",
            f"## {room.capitalize()}",
            "",
            "| case | why it is hard | what must hold | worst | limit | guard | |",
        ]
        lines += ["|---|---|---|---|---|---|---|"]
        for row in report["cases"]:
            if row["room"] == room:
                worst = "-" if row["worst"] is None else f"{row['worst']:.2g}"
                verdict = "pass" if row["passed"] else f"**FAIL** {row['error']}"
                note = f" ({row['note']})" if row["note"] else ""
                cells = [
                    row["case"],
                    row["why"],
                    row["holds"] + note,
                    worst,
                    f"{row['limit']:g}",
                    f"`{row['guard']}`",
                    verdict,
                ]
                lines.append("| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |")
    lines += [
        "",
        "## Does the suite bite?",
        "",
        "`python -m tests.hard_cases mutate` takes a guard away in a fresh process; its case must fail.",
    ]
    lines += ["", "| guard | without it | case that fails | |", "|---|---|---|---|"]
    for row in report["mutants"]:
        cells = [f"`{row['guard']}`", row["without"], row["case"], "caught" if row["caught"] else "**MISSED**"]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def mutate(pool: multiprocessing.pool.Pool, out: Path) -> int:
    """Every mutant, printed and kept in the report."""
    rows = []
    for name, caught in zip(MUTANTS, track(pool.imap(bitten, MUTANTS), "mutants", len(MUTANTS)), strict=True):
        guard = CASES[name].guard
        rows.append({"case": name, "guard": guard.symbol, "without": guard.without, "caught": caught})
        print(f"{'caught' if caught else 'MISSED'}  {name}: {guard.symbol}")
    path = out / FILE
    report = json.loads(path.read_text()) if path.exists() else {"seeds": SEEDS, "seconds": 0, "cases": []}
    report["mutants"] = rows
    path.write_text(json.dumps(report, indent=1) + "\n")
    (out / PAGE).write_text(page(report))
    return 0 if all(row["caught"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
