"""The closed loop outside the training set: worlds by Latin hypercube, drawn objects, all variants on equal starts."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from reporting.page import page
from reporting.statistics import wilson
from reporting.table import table
from simulation.closed_loop.benchmark import figures
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import MEASURED, Perception, job_in
from simulation.closed_loop.statistics import Row, ends
from simulation.scene.drawn import QUANTITIES
from simulation.scene.rubber import shear_reach_pitches
from simulation.scene.scene import SceneError
from simulation.scene.worlds import World, load_scene

NAME = "drawn_worlds"
DECILES = 10
COLUMNS: tuple[Any, ...] = (
    ("mean trials", "mean_trials", ".2f"),
    ("refused", "refused", "d"),
    ("direction", lambda row: wilson(row["direction_right"], row["direction_n"]), ".0%"),
    ("MAE x mm", "mae_x_mm", ".2f"),
    ("MAE yaw deg", "mae_theta_deg", ".2f"),
    ("90 % coverage x", "covered_x", ".0%"),
    ("90 % coverage yaw", "covered_theta", ".0%"),
    ("max force N", "worst_force_n", ".0f"),
)
"""Columns of a table of insertions, after those of claims and insertions."""
_TRIES = 50


class Variant(NamedTuple):
    """A variant: a title, networks, a controller, and what they get.

    ``given_reach``: the client sends a measured shear reach; all else that it states is the same. ``perception``: the
    networks read pictures, or true marker positions with the tracker's error.
    """

    title: str
    models: Path
    controller: str
    given_reach: bool
    perception: Perception = "fields"


class Start(NamedTuple):
    """One insertion before it is played."""

    world: World
    scene: str
    x_mm: float
    theta_deg: float
    reach_pitches: float

    def job(self, index: int, seed: int, **more: Any) -> dict[str, Any]:
        """Fields of its `Job`; see `job_in`."""
        return job_in(self.world, self.scene, index, (self.x_mm, self.theta_deg), seed, **more)


def starts(worlds: Sequence[World], objects: Sequence[str], count: int, seed: int) -> list[Start]:
    """``count`` insertions, the worlds in turn, each with a suitable object and a drawn start."""
    rng = np.random.default_rng((seed, 0xD2A))
    return [_start(worlds[index % len(worlds)], objects, rng) for index in range(count)]


def _start(world: World, objects: Sequence[str], rng: np.random.Generator) -> Start:
    for _ in range(_TRIES):
        name = objects[int(rng.integers(len(objects)))]
        try:
            scene = world.around(load_scene(name))
        except SceneError:
            continue  # this object cannot be held in this world
        x, theta = rng.uniform(-1.0, 1.0, 2) * (scene.x_range_mm, scene.theta_range_deg)
        return Start(world, name, float(x), float(theta), shear_reach_pitches(scene))
    raise ValueError(f"world {world.name}: none of {_TRIES} objects drawn can be held in it")


def tasks(variants: Sequence[Variant], begun: Sequence[Start], seed: int) -> list[Task]:
    """Every start by every variant, start by start: an interrupted run is still balanced."""
    return [
        Task(
            variant.models,
            start.job(
                index,
                seed * 1_000_000 + index,
                controller=variant.controller,
                perception=variant.perception,
                condition=f"{start.world.name}: {variant.title}",
                given_reach=variant.given_reach,
            ),
        )
        for index, start in enumerate(begun)
        for variant in variants
    ]


def report_of(
    rows: Sequence[Row], variants: Sequence[Variant], begun: Sequence[Start], setup: Mapping[str, Any]
) -> Row:
    """The data behind the page, as plain data; ``release``: all variants with the networks of the first, counted."""
    reach = np.array([start.reach_pitches for start in begun])
    by_variant = {variant.title: rows[place :: len(variants)] for place, variant in enumerate(variants)}
    first = next(iter(by_variant.values()))
    ours = [variant.title for variant in variants if variant.models == variants[0].models]
    return {
        "simulated": True,
        "setup": dict(setup),
        "worlds": len({start.world.name for start in begun}),
        "objects": len({start.scene for start in begun}),
        "release": ends([row for title in ours for row in by_variant[title]]),
        "variants": [{"variant": title, **figures(mine)} for title, mine in by_variant.items()],
        "deciles": list(_deciles(first, reach)),
        "tiers": [
            {"tier": tier, **figures([row for row in first if row["changes"]["gel.tier"] == tier])}
            for tier in sorted({row["changes"]["gel.tier"] for row in first})
        ],
    }


def _deciles(rows: Sequence[Row], reach: Any) -> Iterator[Row]:
    edges = np.quantile(reach, np.linspace(0.0, 1.0, DECILES + 1))
    place = np.digitize(reach, edges[1:-1])
    for decile in range(DECILES):
        mine = [row for row, where in zip(rows, place, strict=True) if where == decile]
        if mine:
            yield {"low": float(edges[decile]), "high": float(edges[decile + 1]), **figures(mine)}


def _most(unstated: str) -> str:
    return f"{QUANTITIES[f'world.{unstated}'](1.0):g}"


def _how(data: Row) -> str:
    return f"""
        ## How it was measured

        {data["worlds"]} worlds are drawn by Latin hypercube from the ranges of [worlds](worlds.md), with
        {data["objects"]} drawn objects. The networks were trained on other draws from the same ranges. All variants run
        from the same starts. Marker positions are the true ones [plus the tracker's
        error](decisions/0018-closed-loop-in-lock-step.md#what-true-fields-leave-out). A failure counts as 16
        trials.

        The client states gap width and grasp height with the errors of each world, up to {_most("told_gap_error_mm")}
        and {_most("told_height_error_mm")} mm, and grip and speed as they are. The release's variants differ in the
        shear reach alone: given with the error of a cell that has measured it, {100 * MEASURED:.0f} %, or not given. No
        variant has timed its pictures and its arm.
        """


def drawn_worlds_page(data: Row) -> str:
    release, starts_n = data["release"], data["variants"][0]["insertions"]
    ours = data["variants"][: release["insertions"] // starts_n]
    wrong = wilson(max(row["claimed_wrongly"] for row in ours), starts_n)
    done = wilson(min(row["inserted"] for row in ours), starts_n)
    return page(
        f"""
        # Drawn worlds, simulated

        **{release["claimed_wrongly"]} of {release["insertions"]} insertions of the release ended in a false claim.**
        Its variants play the same {starts_n} starts, so shares are of one variant, with the 95 % Wilson interval: at
        worst {wrong:.2%} were false claims, and {done:.1%} were inserted.

        """,
        _how(data),
        """
        ## Results
        """,
        table(
            data["variants"],
            ("variant", "variant"),
            ("false claims", "claimed_wrongly", "d"),
            ("inserted", lambda row: wilson(row["inserted"], row["insertions"]), ".1%"),
            *COLUMNS,
            ("void", "void", "d"),
        ),
        "By decile of the shear reach, first variant:",
        table(
            data["deciles"],
            ("reach, marker pitches", lambda row: f"{row['low']:.2f} .. {row['high']:.2f}"),
            ("false claims", "claimed_wrongly", "d"),
            ("inserted", lambda row: f"{row['inserted']} of {row['insertions']}"),
            *COLUMNS,
        ),
        "By tier of the simulated gel, first variant:",
        table(
            data["tiers"],
            ("tier", "tier"),
            ("false claims", "claimed_wrongly", "d"),
            ("inserted", lambda row: wilson(row["inserted"], row["insertions"]), ".1%"),
            *COLUMNS,
        ),
        data.get("note", ""),
        "`make drawn-worlds` plays 300 other worlds and writes this page.",
    )
