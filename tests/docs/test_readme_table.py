"""The README's table of eight objects is that of docs/middle.json, as `evaluate --json` wrote it."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]


def cells_of(first: str) -> list[str]:
    """The row of the README's tables that begins so, without its first cell."""
    (line,) = [line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith(f"| {first}")]
    return [cell.strip() for cell in line.strip("|").split("|")][1:]


def test_the_table_of_eight_objects_is_what_was_played() -> None:
    rows = {row["object"]: row for row in json.loads((ROOT / "docs" / "middle.json").read_text())}
    named = [rows.pop(name.replace(" ", "_")) for name in cells_of("32 insertions each")]
    assert not rows
    assert cells_of("inserted (simulated)") == [f"{row['inserted']}/{row['insertions']}" for row in named]
    assert cells_of("mean attempts (simulated)") == [f"{row['mean_trials']:.2f}" for row in named]
    total = sum(row["inserted"] for row in named), sum(row["insertions"] for row in named)
    summary, _, wrong = cells_of("[eight objects in the middle of the ranges]")
    assert summary.startswith(f"{total[0]} of {total[1]} ")
    assert wrong.startswith("none ") == (sum(row["claimed_wrongly"] for row in named) == 0)
