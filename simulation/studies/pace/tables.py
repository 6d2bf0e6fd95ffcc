"""The tables of the page of seconds a box."""

from collections.abc import Set as AbstractSet

from reporting.statistics import wilson
from reporting.table import Table, table
from simulation.closed_loop.statistics import Row


def columns(data: Row, best: AbstractSet[str]) -> Table:
    """The table of all choices; those on the front are bold."""
    count = data["insertions"]
    return table(
        data["points"],
        ("settings", lambda p: f"**{p['name']}**" if p["name"] in best else p["name"]),
        ("seconds a box", "seconds_a_box", ".1f"),
        ("times faster", "faster", ".2f"),
        ("median s", "seconds.median", ".1f"),
        ("95 % s", "seconds.95", ".1f"),
        ("inserted", lambda p: wilson(p["inserted"], count), ".0%"),
        ("gained, lost", lambda p: f"{p['gained']}, {p['lost']}"),
        ("false claims", "claimed_wrongly", "d"),
        ("attempts", "attempts", ".2f"),
        ("regrasps", "trips", ".2f"),
        ("force 95 %, N", "force_n.95", ".1f"),
        ("largest N", "force_n.largest", ".1f"),
        ("harder, N", "harder_n", "+.1f"),
        ("unseen, mm", "unseen_mm", ".2f"),
    )


def parts(data: Row) -> Table:
    """Where the seconds go: means; median and 95 % of the whole are in the other table."""
    names = [n for n in data["points"][0]["parts"] if any(p["parts"][n]["mean"] >= 0.005 for p in data["points"])]
    return table(
        data["points"],
        ("settings", "name"),
        *((name, lambda p, name=name: p["parts"][name]["mean"], ".2f") for name in names),
        ("touch to last frame", lambda p: p["frames_s"] and p["frames_s"]["mean"], ".2f"),
    )


def by_group(data: Row) -> Table:
    """What ships, by object and by what a world is like."""
    return table(
        data["groups"],
        ("by", "by"),
        ("group", "name"),
        ("insertions", "insertions", "d"),
        ("inserted", lambda g: wilson(g["inserted"], g["insertions"]), ".0%"),
        ("seconds a box", "seconds_a_box", ".1f"),
        ("median s", "median", ".1f"),
        ("95 % s", "95", ".1f"),
        ("attempts", "attempts", ".2f"),
    )
