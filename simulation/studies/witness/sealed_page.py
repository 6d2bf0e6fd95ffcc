"""Page of the sealed test: missed targets first, then the figures, then every failure."""

import re
from collections import Counter
from typing import Any

from reporting.page import missed_first, page
from reporting.statistics import Estimate, clustered, number, wilson
from reporting.table import Table, table
from simulation.studies.drawn_worlds import COLUMNS
from simulation.studies.witness.sealed import ALIKE, EACH, FAMILIES, WITNESS

Row = dict[str, Any]
NUMBER = r"-?\d+\.\d+"
LEAST_INSERTED, MOST_TRIALS, LEAST_COVERED = 0.95, 3.2, 0.80


def foreign_world_page(data: Row) -> str:
    whole = next(row for row in data["figures"] if (row["cell"], row["family"]) == (WITNESS, "all"))
    failed = data["failed"]
    return page(
        "# The sealed test in another physics, simulated",
        _against_targets(whole, _inserted(data, whole)),
        f"""
        ## How it was measured

        The released networks, without adaptation, run in a [cell of finite elements](foreign_check.md) that shares no
        code with the physics that trained them. [foreign_world.csv](foreign_world.csv) lists every insertion.

        - **Seal.** Worlds, objects and starts follow from the SHA-256 of the network files and a counter
          ({data["counter"]}): `{data["seal"][:16]}`. Nobody can choose them.
        - **Three families of gels.** *Edges near*: the gel ends within 1 mm of the markers. *Edges far*: it extends at
          least 5 mm beyond them. *Stiff and slippery*: it slides after 0.15 to 0.4 marker pitches.
        - **Everything else**, objects included, is drawn from the ranges of [worlds](worlds.md). Poisson's ratio is
          that of rubber, 0.45 to 0.495. No gel relaxes and no finger bends.
        - **Scoring.** Marker positions are the true ones [plus the tracker's
          error](decisions/0018-closed-loop-in-lock-step.md#what-true-fields-leave-out). The shear reach was not given
          to the
          networks. A failure counts as 16 trials. The interval of what the release inserted in the elements is as wide
          as the worlds differ: each has up to {EACH} insertions.
        {_baselines(data)}
        """,
        table([{**row, "share": _inserted(data, row)} for row in data["figures"]], *_FIGURES),
        *(_failures(failed) if failed else ()),
        data.get("note", ""),
        *(_tests_before(data["before"]) if data.get("before") else ()),
        f"""
        Made by `python -m simulation sealed --count {data["count"]} --counter {data["counter"]} --docs docs`.
        """,
    )  # fmt: skip


def _failures(failed: list[Row]) -> tuple[str | Table, ...]:
    return (
        f"## Why {len(failed)} insertions failed",
        table(Counter(map(cause, failed)).most_common(), ("cause", 0), ("insertions", 1, "d")),
        "## Each failure",
        table(
            failed,
            ("world", "world"),
            ("object", "object"),
            ("start x mm", "start_x_mm", ".1f"),
            ("yaw deg", "start_yaw_deg", ".1f"),
            ("reach, pitches", "reach_pitches", ".2f"),
            ("attempts", "attempts", "d"),
            ("claimed", lambda row: "yes" if row["claimed"] else "no"),
            ("end x mm", "end_x_mm", ".1f"),
            ("yaw deg", "end_yaw_deg", ".1f"),
            ("max force N", "force_n", ".0f"),
            ("cause", cause),
        ),
    )


def _tests_before(rows: list[Row]) -> tuple[str | Table, ...]:
    return (
        """
        ## Earlier tests

        Each was played in other worlds, with the software and the networks of its time. *Change*: what the test before
        it had led to.
        """,
        table(
            rows,
            ("networks", "networks"),
            ("counter", "counter", "d"),
            ("change", "new"),
            ("inserted", "inserted"),
            ("false claims", "untrue", "d"),
            ("bristle tier: inserted", "bristle"),
            ("bristle tier: false claims", "bristle_untrue", "d"),
        ),
    )


def _baselines(data: Row) -> str:
    """What else ran the same starts, as one more item of the list; nothing where the release ran alone."""
    ran = {row["cell"] for row in data["figures"]}
    texts = [text for cell, text in _OTHERS.items() if cell in ran]
    return f"- **Baselines** on the first of the same starts: {'; '.join(texts)}." if texts else ""


_OTHERS = {
    "bristle": "the release in our bristle tier",
    "layer": "the release in our layer tier",
    "older": "in the elements, the release before",
    "recipe": "in the elements, the paper's recipe, which reads pictures and decides by the paper's heuristic",
    "oracle": "in the elements, an oracle that moves by the true error",
}
_TITLES = {
    ALIKE: f"{WITNESS}, {ALIKE}",
    "older": f"{WITNESS}, release before",
    "recipe": f"{WITNESS}, the paper's recipe",
    "oracle": f"{WITNESS}, oracle",
}
_FIGURES: tuple[Any, ...] = (
    ("cell", lambda row: _TITLES.get(row["cell"], row["cell"])),
    ("family", "family"),
    ("false claims", lambda row: f"{row['claimed_wrongly']} of {row['insertions']}"),
    ("inserted", "share", ".1%"),
    *COLUMNS,
    ("void", "void", "d"),
)


def _inserted(data: Row, row: Row) -> Estimate:
    """The share of a row that was inserted. Insertions in one world may fail alike; only WITNESS plays many of them."""
    if row["cell"] != WITNESS:
        return wilson(row["inserted"], row["insertions"])
    failed, count = Counter(one["world"] for one in data["failed"]), data["count"]
    of_each = {
        f"{family} {first // EACH}": min(EACH, count - first)
        for family in FAMILIES
        for first in range(0, count, EACH)
        if row["family"] in ("all", family)
    }
    return clustered([played - failed[world] for world, played in of_each.items()], [*of_each.values()])


def _against_targets(whole: Row, inserted: Estimate) -> str:
    """The figures beside their targets, what is missed first."""
    count = whole["insertions"]
    wrong = wilson(whole["claimed_wrongly"], count)
    covered = min(share if share is not None else 0.0 for share in (whole["covered_x"], whole["covered_theta"]))
    wrongly, done = whole["claimed_wrongly"], whole["inserted"]
    least, held = number(LEAST_INSERTED, ".0%"), number(covered, ".0%")
    checks = (
        (
            wrongly == 0,
            f"{wrongly} of {count} insertions ended in a false claim, {wrong:.1%}; target: none",
        ),
        (
            inserted.low >= LEAST_INSERTED,
            f"{done} of {count} were inserted, {inserted:.1%}; target: a lower bound of {least}",
        ),
        (
            whole["mean_trials"] <= MOST_TRIALS,
            f"{whole['mean_trials']:.2f} mean trials; target: at most {MOST_TRIALS}",
        ),
        (
            covered >= LEAST_COVERED,
            f"90 % intervals of first decisions cover the truth in {held}; target: {number(LEAST_COVERED, '.0%')}",
        ),
    )
    return missed_first(checks, between=". ")


def cause(row: Row) -> str:
    """Why an insertion failed, in one line."""
    if row["claimed"]:
        return f"claimed, but {re.sub(NUMBER, 'x', row['shortfalls'][0]) if row['shortfalls'] else 'not held'}"
    if row["reason"]:
        return ": ".join(str(row["reason"]).split(": ")[:2])[:90]
    return "trials used up" if row["grasp_kept"] else "the object left the grasp"
