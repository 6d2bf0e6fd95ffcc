"""What a soak measured, on the terminal and in docs/soak.md and .json."""

import argparse
from collections import Counter
from typing import Any

from reporting.page import page, publish
from reporting.statistics import percentiles
from reporting.table import table
from tests.service.soak.memory import LEAK_MB_PER_H, Slope
from tests.service.soak.soak import Soak


def report(
    soak: Soak, troubles: Counter[str], errors: list[str], code: object, options: argparse.Namespace, machine: dict
) -> int:
    slopes = {kind: soak.slope(kind) for kind in ("all", "own", "files")}
    memory = [m["all"] for _, m in soak.at_rest] or [float("nan")]
    edge = max(1, len(memory) // 10)
    facts = {
        "minutes": round((soak.samples[-1][0] if soak.samples else 0) / 60, 1),
        "insertions": soak.counts["insertions"],
        "slope_at_rest_mb_per_h": {kind: vars(slope) for kind, slope in slopes.items()},
        "limit_mb_per_h": LEAK_MB_PER_H,
        "at_rest_mb": {"first tenth": median(memory[:edge]), "last tenth": median(memory[-edge:])},
        "most_mb": round(max([s[1] for s in soak.samples] or [float("nan")]), 1),
        "threads": extent([s[2] for s in soak.samples]),
        "open_files": extent([s[3] for s in soak.samples]),
        "wrong_attempt_messages": soak.wrong,
        "lost_recordings": soak.lost,
        "unexpected_errors": errors[:20],
        "exit_code_of_the_service": code,
        "counts": dict(sorted(soak.counts.items())),
        "troubles": dict(sorted(troubles.items())),
        "machine": machine,
        "seed": options.seed,
        "camera_rate_hz": options.rate_hz,
        "at_rest_mb_by_s": [[round(at_s), round(m["all"], 1), round(m["own"], 1)] for at_s, m in soak.at_rest],
        "memory_held": not slopes["all"].leaks,
    }
    print(publish(options.docs, "soak", soak_page(facts), facts))
    return 0 if held(facts) else 1


def median(values: list[float]) -> float:
    return round(percentiles(values, 50)[0], 1)


def extent(values: list[int]) -> list[int]:
    return [min(values, default=0), max(values, default=0)]


def held(facts: dict[str, Any]) -> bool:
    failures = ("wrong_attempt_messages", "lost_recordings", "unexpected_errors", "exit_code_of_the_service")
    return facts["memory_held"] and not any(facts[name] for name in failures)


def soak_page(facts: dict[str, Any]) -> str:
    counts, machine = facts["counts"], facts["machine"]
    faults = ", ".join(f"{name[6:]} {count}" for name, count in counts.items() if name.startswith("fault "))
    return page(
        f"""
        # Soak of the service

        {"**Everything held.**" if held(facts) else "**Something did not hold; see the rows and soak.json.**"}

        The soak ran for {facts["minutes"]:.0f} minutes on {machine["cpu"]}, with {machine["cores"]} cores shared with
        other work (load {machine["load"][1]:.1f}), cameras at {facts["camera_rate_hz"]:g} Hz and seed {facts["seed"]}.
        `make soak` repeats it.
        """,
        table(measurements(facts), ("quantity", 0), ("measured", 1)),
        "Disturbances during the soak:",
        "\n".join(f"- {name}: {count}" for name, count in facts["troubles"].items()),
        f"Faults reported by the service: {faults}.",
    )


def measurements(facts: dict[str, Any]) -> list[tuple[str, Any]]:
    counts, memory = Counter(facts["counts"]), facts["at_rest_mb"]
    slopes = {kind: Slope(**values) for kind, values in facts["slope_at_rest_mb_per_h"].items()}
    limit = f"limit {facts['limit_mb_per_h']:g} for the upper end: {'held' if facts['memory_held'] else '**missed**'}"
    return [
        ("insertions", facts["insertions"]),
        ("clients killed / reconnected", f"{counts['clients killed']} / {counts['clients that came back']}"),
        ("corrections, refusals", [counts["message correction"], counts["message no_decision"]]),
        ("messages for a wrong attempt or insertion", len(facts["wrong_attempt_messages"])),
        (
            "completed recordings verified / lost",
            f"{counts['finished recordings verified']} / {len(facts['lost_recordings'])}",
        ),
        ("recordings of abandoned insertions that were closed", counts["abandoned recordings verified"]),
        ("slope of resident memory at rest, after the first fifth", f"{slopes['all']}; {limit}"),
        ("of which heap and libraries", f"{slopes['own'].mb_per_h:+.1f}, {slopes['files'].mb_per_h:+.1f} MB per hour"),
        ("resident memory at rest, first and last tenth", f"{memory['first tenth']} and {memory['last tenth']} MB"),
        ("peak resident memory during an insertion", f"{facts['most_mb']} MB"),
        ("threads, min to max", "{} to {}".format(*facts["threads"])),
        ("open files, min to max", "{} to {}".format(*facts["open_files"])),
        ("unexpected errors and 5xx responses", len(facts["unexpected_errors"])),
        ("exit code of the service after a stop request", facts["exit_code_of_the_service"]),
    ]
