"""What a soak found, on the terminal and in docs/soak.md and .json."""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np

from tests.service.soak.memory import LEAK_MB_PER_H, Slope
from tests.service.soak.soak import Soak


def report(
    soak: Soak, troubles: Counter[str], errors: list[str], code: object, told: argparse.Namespace, machine: dict
) -> int:
    slopes = {kind: soak.slope(kind) for kind in ("all", "own", "files")}
    leaks = slopes["all"].leaks
    memory = [m["all"] for _, m in soak.at_rest] or [float("nan")]
    edge = max(1, len(memory) // 10)
    facts = {
        "minutes": round((soak.samples[-1][0] if soak.samples else 0) / 60, 1),
        "insertions": soak.seen["insertions"],
        "slope_at_rest_mb_per_h": {kind: vars(found) for kind, found in slopes.items()},
        "limit_mb_per_h": LEAK_MB_PER_H,
        "at_rest_mb": {"first tenth": median(memory[:edge]), "last tenth": median(memory[-edge:])},
        "most_mb": round(max([s[1] for s in soak.samples] or [float("nan")]), 1),
        "threads": extent([s[2] for s in soak.samples]),
        "open_files": extent([s[3] for s in soak.samples]),
        "wrong_attempt_messages": soak.wrong,
        "lost_recordings": soak.lost,
        "unexpected_errors": errors[:20],
        "exit_code_of_the_service": code,
        "seen": dict(sorted(soak.seen.items())),
        "troubles": dict(sorted(troubles.items())),
        "machine": machine,
        "seed": told.seed,
        "camera_rate_hz": told.rate_hz,
        "at_rest_mb_by_s": [[round(at_s), round(m["all"], 1), round(m["own"], 1)] for at_s, m in soak.at_rest],
        "memory_held": not leaks,
    }
    held = not (soak.wrong or soak.lost or errors or leaks) and code == 0
    told.docs.mkdir(parents=True, exist_ok=True)
    (told.docs / "soak.json").write_text(json.dumps(facts, indent=1) + "\n")
    (told.docs / "soak.md").write_text(page(facts, held))
    print((told.docs / "soak.md").read_text())
    return 0 if held else 1


def median(values: list[float]) -> float:
    return round(float(np.median(values)), 1)


def extent(values: list[int]) -> list[int]:
    return [min(values, default=0), max(values, default=0)]


def page(facts: dict, held: bool) -> str:
    memory, slopes = facts["at_rest_mb"], {k: Slope(**v) for k, v in facts["slope_at_rest_mb_per_h"].items()}
    verdict = f"limit {facts['limit_mb_per_h']:g} for the upper end: {'held' if facts['memory_held'] else '**missed**'}"
    rows = [
        ("insertions", facts["insertions"]),
        ("clients killed / came back", f"{seen(facts, 'clients killed')} / {seen(facts, 'clients that came back')}"),
        ("corrections, refusals", f"{seen(facts, 'message correction')}, {seen(facts, 'message no_decision')}"),
        ("messages for a wrong attempt or insertion", len(facts["wrong_attempt_messages"])),
        ("finished recordings verified / lost", f"{seen(facts, 'finished recordings verified')} / {lost(facts)}"),
        ("abandoned insertions whose recording was closed", seen(facts, "abandoned recordings verified")),
        ("slope of resident memory at rest, after the first fifth", f"{slopes['all']}; {verdict}"),
        ("of that heaps, libraries", f"{slopes['own'].mb_per_h:+.1f}, {slopes['files'].mb_per_h:+.1f} MB an hour"),
        ("resident at rest, first and last tenth", f"{memory['first tenth']} and {memory['last tenth']} MB"),
        ("most resident while an insertion is under way", f"{facts['most_mb']} MB"),
        ("threads, open files (least to most)", f"{facts['threads']}, {facts['open_files']}"),
        ("unexpected errors, answers 5xx", len(facts["unexpected_errors"])),
        ("exit code of the service when asked to stop", facts["exit_code_of_the_service"]),
    ]
    lines = [
        "# Soak of the service",
        "",
        where(facts),
        "",
        "**Everything held.**" if held else "**Something did not hold; see the rows and soak.json.**",
        "",
        "| what | found |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows),
        "",
        "Trouble made meanwhile:",
        "",
        *(f"- {name}: {count}" for name, count in facts["troubles"].items()),
        "",
        "Faults the service told of: "
        + ", ".join(f"{k[6:]} {v}" for k, v in facts["seen"].items() if k[:6] == "fault "),
        "",
    ]
    return "\n".join(lines)


def where(facts: dict) -> str:
    machine = facts["machine"]
    return (
        f"{facts['minutes']:.0f} minutes on {machine['cpu']}, {machine['cores']} cores shared with other work"
        f" (load {machine['load'][1]:.1f}); cameras at {facts['camera_rate_hz']:g} Hz, seed {facts['seed']}."
        " `make soak` repeats it."
    )


def seen(facts: dict, name: str) -> int:
    return int(facts["seen"].get(name, 0))


def lost(facts: dict) -> int:
    return len(facts["lost_recordings"])


if __name__ == "__main__":
    print(page(json.loads(Path("docs/soak.json").read_text()), held=True))
