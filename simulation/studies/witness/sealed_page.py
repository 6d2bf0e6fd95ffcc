"""Page of the sealed test: what is missed first, then the figures, then every failure."""

import re
from collections import Counter
from typing import Any

from reporting.page import missed_first, page
from reporting.statistics import number, wilson
from reporting.table import Table, table
from simulation.studies.drawn_worlds import COLUMNS
from simulation.studies.witness.sealed import ALIKE, WITNESS

Row = dict[str, Any]
NUMBER = r"-?\d+\.\d"
LEAST_INSERTED, MOST_TRIALS, LEAST_COVERED = 0.95, 3.2, 0.80


def foreign_world_page(data: Row) -> str:
    whole = next(row for row in data["figures"] if (row["cell"], row["family"]) == (WITNESS, "all"))
    failed = data["failed"]
    return page(
        f"""
        # The sealed test in another physics, simulated

        {_asked_and_reached(whole)}
        """,
        data.get("note", ""),
        f"""
        The released networks, not adapted, play in a [cell of finite elements](foreign_check.md) that shares no code
        with the physics that trained them. Worlds, objects and starts follow from the SHA-256 of the network files and
        a counter ({data["counter"]}): `{data["seal"][:16]}`. Nobody can choose them, and every one that was played is
        in [foreign_world.csv](foreign_world.csv). Three families: gels that end within 1 mm of the markers, gels
        that go on for 5 mm and more, and stiff gels that slide after 0.15 to 0.4 marker pitches. The rest of a world
        is drawn over what cells are ([worlds](worlds.md)), with all that the software is not given; Poisson's ratio is
        that of rubber, 0.45 to 0.495, without viscosity and soft fingers, which the cell has not. Objects are drawn,
        too. Markers are true ones with the tracker's error; the shear reach was not given; a failure counts as 16
        trials. Below the release stands who played the first of these starts beside it: our own tiers{_others(data)}.
        """,
        table(data["figures"], *_FIGURES),
        *(_failures(failed, data.get("pictures")) if failed else ()),
        *(_tests_before(data["before"]) if data.get("before") else ()),
        f"""
        Made by `python -m simulation sealed --count {data["count"]} --counter {data["counter"]} --docs docs`.
        """,
    )  # fmt: skip


def _failures(failed: list[Row], pictures: str | None) -> tuple[str | Table, ...]:
    return (
        f"## What ended the {len(failed)} that failed there",
        table(Counter(map(cause, failed)).most_common(), ("cause", 0), ("insertions", 1, "d")),
        "## Each of them",
        f"![What both cameras showed at the end of up to six, untrue claims first]({pictures})" if pictures else "",
        table(
            failed,
            ("world", "world"),
            ("object", "object"),
            ("start mm", "start_x_mm", ".1f"),
            ("deg", "start_yaw_deg", ".1f"),
            ("reach pitches", "reach_pitches", ".2f"),
            ("attempts", "attempts", "d"),
            ("claimed", "claimed"),
            ("last error mm", "end_x_mm", ".1f"),
            ("deg", "end_yaw_deg", ".1f"),
            ("largest force N", "force_n", ".0f"),
            ("cause", cause),
        ),
    )


def _tests_before(rows: list[Row]) -> tuple[str | Table, ...]:
    return (
        """
        ## The tests before

        The same networks were judged before, each time in other worlds. In between the software changed, by what a
        test had shown:
        """,
        table(
            rows,
            ("counter", "counter", "d"),
            ("what was new", "new"),
            ("inserted", "inserted"),
            ("claimed, not true", "untrue", "d"),
            ("bristle, inserted", "bristle"),
            ("claimed, not true", "bristle_untrue", "d"),
        ),
    )


def _others(data: Row) -> str:
    """Who else decided in the elements."""
    played = {row["cell"] for row in data["figures"]}
    return "".join(f", {text}" for cell, text in _OTHERS.items() if cell in played)


_OTHERS = {
    "older": "in the elements also the [networks before depth](decisions/0075-depth-instead-of-frames.md)",
    "oracle": "an oracle, which moves by the true error",
}
_TITLES = {ALIKE: f"{WITNESS}, {ALIKE}", "older": f"{WITNESS}, release before", "oracle": f"{WITNESS}, oracle"}
_FIGURES: tuple[Any, ...] = (
    ("cell", lambda row: _TITLES.get(row["cell"], row["cell"])),
    ("family", "family"),
    ("claimed, not true", lambda row: f"{row['claimed_wrongly']} of {row['insertions']}"),
    ("inserted", lambda row: wilson(row["inserted"], row["insertions"]), ".1%"),
    *COLUMNS,
    ("void", "void", "d"),
)


def _asked_and_reached(whole: Row) -> str:
    """What was asked for and what came of it, what is missed first."""
    count = whole["insertions"]
    inserted, wrong = wilson(whole["inserted"], count), wilson(whole["claimed_wrongly"], count)
    covered = min(share if share is not None else 0.0 for share in (whole["covered_x"], whole["covered_theta"]))
    wrongly, done = whole["claimed_wrongly"], whole["inserted"]
    least, held = number(LEAST_INSERTED, ".0%"), number(covered, ".0%")
    checks = (
        (
            wrongly == 0,
            f"{wrongly} of {count} insertions ended in a claim that was not true, {wrong:.1%}; asked for: none",
        ),
        (
            inserted.low >= LEAST_INSERTED,
            f"{done} of {count} were inserted, {inserted:.1%}; asked for: a lower bound of {least}",
        ),
        (
            whole["mean_trials"] <= MOST_TRIALS,
            f"{whole['mean_trials']:.2f} trials on the mean; asked for: at most {MOST_TRIALS}",
        ),
        (
            covered >= LEAST_COVERED,
            f"90 % intervals of first decisions hold the truth in {held}; asked for: {number(LEAST_COVERED, '.0%')}",
        ),
    )
    return missed_first(checks, between=". ")


def cause(row: Row) -> str:
    """In one line why an insertion failed."""
    if row["claimed"]:
        return f"claimed, but {re.sub(NUMBER, 'x', row['shortfalls'][0]) if row['shortfalls'] else 'not held'}"
    if row["void"]:
        return "no equilibrium was found"
    if row["reason"]:
        return ": ".join(str(row["reason"]).split(": ")[:2])[:90]
    return "trials used up" if row["grasp_kept"] else "the object left the grasp"
