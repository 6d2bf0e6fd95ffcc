"""docs/commissioning.md from the rows of `python -m simulation commission`: missed targets first."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from reporting.page import missed_first, page
from reporting.statistics import Estimate, clustered, number, wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row
from simulation.studies.commissioning import VERSIONS
from simulation.studies.lateness import errors_ms
from simulation.studies.wiring import MISTAKES

RIGHTLY: Mapping[str, str] = {
    "fingers swapped": "fingers are swapped",
    "left mirrored": "mirrored",
    "right mirrored": "mirrored",
    "both mirrored": "both pictures are mirrored",
    "x reversed": "x reach the arm reversed",
    "yaw reversed": "yaw reach the arm reversed",
}
"""Words that the correct cause of each mistake contains."""
FIGURES: tuple[Any, ...] = (
    ("direction", "direction", ".0%"),
    ("MAE x mm", "mae_x_mm", ".2f"),
    ("MAE yaw deg", "mae_theta_deg", ".2f"),
    ("90 % coverage x", "covered_x", ".0%"),
    ("90 % coverage yaw", "covered_theta", ".0%"),
    ("mean trials", "mean_trials", ".2f"),
    ("inserted", "inserted", ".0%"),
)
_MEASURED = """
## How it was measured

Every cell is drawn from the ranges of [worlds](worlds.md), and the software is given none of its properties.
Marker positions are the true ones [plus the tracker's
error](decisions/0018-closed-loop-in-lock-step.md#what-true-fields-leave-out). Intervals are 95 % Wilson ones; those
over several
worlds are as wide as the worlds differ. A failure counts as 16 trials.

## Four probes name a wiring mistake

[Four probes](decisions/0140-signs-are-asked-for-at-corners.md) test the signs of each drawn world as it is, and
again with each commissioning mistake. Worlds in which no object could be held are left out.
"""
STAGES = ("released", "calibration", "gain", "all", "around")
OF_STAGES: tuple[Any, ...] = (
    ("negative log likelihood", "likelihood", ".3f"),
    ("direction", "accuracy", ".0%"),
    ("MAE x mm", "mae_x_mm", ".2f"),
    ("MAE yaw deg", "mae_theta_deg", ".2f"),
    ("90 % coverage x", "coverage90_x", ".0%"),
    ("90 % coverage yaw", "coverage90_theta", ".0%"),
)
MOST_MINUTES, MOST_ADAPT_S, MOST_TRIALS = 40.0, 600.0, 2.6


def commissioning_page(data: Row) -> str:
    """The whole of docs/commissioning.md from commissioning.json."""
    asked = [row for row in data["rows"] if row["signs_told"] and (_mistake(row) or row.get("wired_right", True))]
    probed = [row for row in data["rows"] if row["verdicts"] and row["released"]["direction_n"]]
    learnt = [row for row in probed if row.get("late", {}).get("late_s", 0.0) is not None]
    return page(
        "# The first day of a cell, simulated",
        _conclusion(asked, probed, learnt),
        _MEASURED,
        _signs(asked),
        _left_out(data["rows"]),
        *_late(data.get("late", ())),
        """
        ## What the cell learns

        The release and the networks that `training adapt` makes from it, after 50 probes, after all, or with production
        insertions only, play the same fresh insertions. Where it [keeps the
        release](decisions/0096-adapting-in-stages.md), the release's figures count. The stage `around` learns from
        [presses simulated around the cell](decisions/0180-presses-around-a-cell.md).
        """,
        _refused(len(probed) - len(learnt), len(probed)),
        "All worlds together:",
        _pooled(learnt),
        "Each world, the smallest gain in mean trials first. What kept the release has no row of its own:",
        _worlds(learnt),
        """
        ## Each stage on held-out probes

        The negative log likelihood covers the direction and the error; of the stages without an objection, the one with
        the lowest is accepted. Means over the attempts of all worlds after 50 probes, the best stage first:
        """,
        _stages(probed),
        "## Each decision and its reasons",
        table(
            [{"world": row["world"], "after": name, **one} for row in probed for name, one in row["verdicts"].items()],
            ("world", "world"),
            ("after", lambda one: one["after"].removeprefix("after_")),
            ("decision", lambda one: f"accepted: {one['best']}" if one["accepted"] else "; ".join(one["objections"])),
            ("attempts", "samples_n", "d"),
            ("gap at x mm", lambda one: _gap(one, 0)),
            ("yaw deg", lambda one: _gap(one, 1)),
            ("time s", "took_s", ".0f"),
        ),
        data["note"],
        "`make commissioning` plays 12 such worlds and writes this page.",
    )


def _late(rows: Sequence[Row]) -> tuple[str, ...]:
    if not rows:
        return ()
    off_ms = errors_ms(rows)
    if not off_ms:
        return (f"In none of {len(rows)} worlds did presses at two speeds tell how late pictures and arm are.",)
    short_n = sum(off < 0.0 for off in off_ms)
    true_ms = [1e3 * row["true_late_s"] for row in rows]
    unknown_n = len(rows) - len(off_ms)
    refused = f" In the other {unknown_n}, `insert` refuses." if unknown_n else ""
    return (
        "## Presses at two speeds tell how late pictures and arm are",
        f"""
        In {len(rows)} drawn worlds, good ones, the cameras' latency and the arm's stop lag together were
        {min(true_ms):.0f} to {max(true_ms):.0f} ms. [Presses](decisions/0194-how-late-pictures-and-arm-are.md) gave a
        bound on them in {len(off_ms)}: {np.mean(off_ms):+.0f} ms from the truth on average, {min(off_ms):+.0f} to
        {max(off_ms):+.0f} ms, and below it in {wilson(short_n, len(off_ms)):.0%}. They take up to
        {max(row["robot_s"] for row in rows):.0f} s of robot time, with the way to the fixture.{refused}
        """,
    )


def _conclusion(asked: Sequence[Row], probed: Sequence[Row], learnt: Sequence[Row]) -> str:
    named = [(row, _mistake(row)) for row in asked]
    wrong = sum(bool(row["mistakes_named"]) for row, mistake in named if not mistake)
    good_n = sum(not mistake for _, mistake in named)
    right = sum(_rightly(row) for row, mistake in named if mistake)
    minutes = max((row["robot_minutes"] for row in probed), default=0.0)
    adapt_s = max((row["adapt_s"] for row in probed), default=0.0)
    checks = (
        (wrong == 0, f"{wrong} of {good_n} good cells were accused of a mistake (target: none)"),
        (
            right == len(asked) - good_n,
            f"{right} of {len(asked) - good_n} mistakes were named with the correct cause (target: all)",
        ),
        (minutes <= MOST_MINUTES, f"at most {minutes:.1f} min of robot time (target: {MOST_MINUTES:.0f})"),
        (adapt_s <= MOST_ADAPT_S, f"at most {adapt_s:.0f} s of adaptation (target: {MOST_ADAPT_S:.0f})"),
    )
    return missed_first([*checks, *(_reached(learnt) if learnt else ())])


def _reached(learnt: Sequence[Row]) -> list[tuple[bool, str]]:
    first, last, few = (_together(learnt, name) for name in ("released", "after_150", "after_50"))
    gain = 100.0 * (last["direction"].value - first["direction"].value)
    holds = few["covered_x"].value, few["covered_theta"].value
    in_x, in_yaw = (number(share, ".0%") for share in holds)
    lost = max(map(_points_lost, learnt))
    return [
        (
            last["direction"].value >= 0.8 or gain >= 12.0,
            (
                f"direction is right in {last['direction']:.0%} after all probes, {first['direction']:.0%} before "
                "(target: 80 % or 12 points more)"
            ),
        ),
        (last["mean_trials"] <= MOST_TRIALS, f"{last['mean_trials']:.2f} mean trials (target: {MOST_TRIALS})"),
        (
            all(0.86 <= share <= 0.94 for share in holds),
            (f"90 % intervals after 50 probes cover {in_x} of errors in x and {in_yaw} in yaw (target: 86 to 94 %)"),
        ),
        (lost <= 1.0, f"direction falls up to {lost:.0f} points below the release in one world (target: 1)"),
    ]


def _together(learnt: Sequence[Row], version: str) -> Row:
    """The figures of one version over all worlds."""
    rows = [row[version] for row in learnt]
    decided, insertions = ([row[name] for row in rows] for name in ("direction_n", "insertions"))

    def mean(name: str, weights: Sequence[int]) -> float:
        return float(np.average([row[name] for row in rows], weights=weights))

    def share(name: str, of: Sequence[int]) -> Estimate:
        return clustered([row[name] for row in rows], of)

    def held(name: str) -> Estimate:
        return clustered([round(row[name] * count) for row, count in zip(rows, decided, strict=True)], decided)

    return {
        "as": version,
        "direction": share("direction_right", decided),
        "mae_x_mm": mean("mae_x_mm", decided),
        "mae_theta_deg": mean("mae_theta_deg", decided),
        "covered_x": held("covered_x"),
        "covered_theta": held("covered_theta"),
        "mean_trials": mean("mean_trials", insertions),
        "inserted": share("inserted", insertions),
        "claimed_wrongly": share("claimed_wrongly", insertions),
    }


def _versions(learnt: Sequence[Row]) -> tuple[str, ...]:
    """The release, and those that any cell learnt; in a cell that did not go on, the last is that of before."""
    return ("released", *(name for name in VERSIONS if any(name in row["verdicts"] for row in learnt)))


def _points_lost(row: Row) -> float:
    """By how many points the direction is right less often than the release's, in the version where that is worst."""

    def share(version: str) -> float:
        return float(row[version]["direction_right"] / row[version]["direction_n"])

    return 100.0 * max(share("released") - share(version) for version in VERSIONS)


def _mistake(row: Row) -> str:
    """What was made wrong in the world of a row, empty in a good one."""
    name = str(row["world"]).rpartition(", ")[2]
    return name if name in MISTAKES else ""


def _rightly(row: Row) -> bool:
    return any(RIGHTLY[_mistake(row)] in cause for cause in row["mistakes_named"])


def _signs(asked: Sequence[Row]) -> Table:
    by_mistake = {name: [row for row in asked if _mistake(row) == name] for name in ("", *MISTAKES)}
    return table(
        [(name, rows) for name, rows in by_mistake.items() if rows],
        ("cell", lambda pair: pair[0] or "good"),
        ("worlds", lambda pair: len(pair[1]), "d"),
        ("any mistake named", lambda pair: _share(pair[1], [bool(row["mistakes_named"]) for row in pair[1]]), ".0%"),
        ("correct cause", lambda pair: _share(pair[1], [_rightly(r) for r in pair[1]]) if pair[0] else "-", ".0%"),
    )


def _left_out(rows: Sequence[Row]) -> str:
    """Worlds that are neither good nor one of these mistakes made in a good one."""
    own_n = sum(not row.get("wired_right", True) and not _mistake(row) for row in rows)
    return f"{own_n} worlds whose own file states a mistake are left out." if own_n else ""


def _share(rows: Sequence[Row], hits: Sequence[bool]) -> Estimate:
    return wilson(sum(hits), len(rows))


def _refused(refused_n: int, worlds_n: int) -> str:
    """Worlds whose insertions no client would make."""
    if not refused_n:
        return ""
    return (
        f"Insertions in {refused_n} of {worlds_n} worlds do not count: presses had not told how late pictures and "
        "arm are, so that `insert` refuses. Their probes and networks are in the tables below."
    )


def _pooled(learnt: Sequence[Row]) -> Table:
    return table(
        [_together(learnt, version) for version in _versions(learnt)] if learnt else (),
        ("networks", lambda row: row["as"].replace("_", " ")),
        *FIGURES,
        ("false claims", "claimed_wrongly", ".1%"),
    )


def _worlds(learnt: Sequence[Row]) -> Table:
    def worse(row: Row) -> float:
        return float(row["released"]["mean_trials"] - row["after_150"]["mean_trials"])

    rows = [
        {**_together([row], name), "world": row["world"], "claimed_wrongly": row[name]["claimed_wrongly"]}
        for row in sorted(learnt, key=worse)
        for name in _versions(learnt)
        if name == "released" or row[name] != row["released"]
    ]
    return table(
        rows,
        ("world", "world"),
        ("networks", lambda row: row["as"].replace("_", " ")),
        *FIGURES,
        ("false claims", "claimed_wrongly", "d"),
    )


def _stages(learnt: Sequence[Row]) -> Table:
    """Each stage after 50 probes, over the worlds in which it was fitted."""
    outcomes = [row["verdicts"]["after_50"] for row in learnt if row["verdicts"]["after_50"]["figures"]]
    weights = [outcome["samples_n"] for outcome in outcomes]

    def mean(stage: str, name: str) -> float:
        return float(np.average([outcome["figures"][stage][name] for outcome in outcomes], weights=weights))

    names = [name for name in STAGES if outcomes and all(name in outcome["figures"] for outcome in outcomes)]
    rows = [{"stage": name, **{key: mean(name, key) for _, key, _ in OF_STAGES}} for name in names]
    return table(sorted(rows, key=lambda row: row["likelihood"]), ("stage", "stage"), *OF_STAGES)


def _gap(outcome: Row, axis: int) -> str:
    at, sigma, probes_n = outcome.get("gap") or ((0.0, 0.0), (0.0, 0.0), 0)
    return f"{at[axis]:+.1f} +- {sigma[axis]:.1f}" if probes_n else "-"
