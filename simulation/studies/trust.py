"""Claims under adversity: insertions drawn from faults, worlds, objects and starts, and the page of what was claimed.

What counts first is a claim that is not true. A claim is only as good as the ground truth that it is held against
(`simulation.scene.ground_truth`), so both the claims and the truths that were not claimed are counted.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from reporting.page import page, publish
from reporting.statistics import wilson
from reporting.table import table
from service.contract import FINGERS, Finger
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import job_in
from simulation.closed_loop.statistics import Row
from simulation.closed_loop.true_fields import Fault, Kind
from simulation.scene.scene import Scene, SceneError
from simulation.scene.worlds import World

NAME = "trust"
FAULT_FREE = 0.5  # of all insertions
KINDS: tuple[Kind, ...] = ("dark", "frozen", "stuck", "dropped")
BLIND: tuple[tuple[Finger, ...], ...] = (("left",), ("right",), FINGERS)
DEEPEST_MM = 24.0


def tasks(
    worlds: Sequence[World], objects: Mapping[str, Scene], count: int, seed: int, models: Path, made_by: str
) -> list[Task]:
    """``count`` insertions, each with its own draw of world, object, start and fault; the same for the same seed."""
    rng = np.random.default_rng((seed, 0x7A57))
    todo: list[Task] = []
    while len(todo) < count:
        world = worlds[int(rng.integers(len(worlds)))]
        name = list(objects)[int(rng.integers(len(objects)))]
        fault = _fault(rng)
        shares = rng.uniform(-1.0, 1.0, 2)
        try:
            scene = world.around(objects[name])
        except SceneError:
            continue  # this object cannot be held in this world
        start = (shares[0] * scene.x_range_mm, shares[1] * scene.theta_range_deg)
        told = {
            "condition": f"{world.name}: {fault.kind if fault else 'no fault'}",
            "fault": {**asdict(fault), "fingers": list(fault.fingers)} if fault else {},
        }
        job = job_in(world, name, len(todo), start, seed * 1_000_000 + len(todo), **told)
        todo.append(Task(models, job, made_by))
    return todo


def _fault(rng: np.random.Generator) -> Fault | None:
    if rng.random() < FAULT_FREE:
        return None
    kind = KINDS[int(rng.integers(len(KINDS)))]
    fingers = BLIND[int(rng.integers(len(BLIND)))]
    attempt = int(rng.integers(1, 3))
    depth_mm = float(rng.uniform(-4.0, DEEPEST_MM))
    return Fault(kind, FINGERS if kind == "dropped" else fingers, attempt, depth_mm)


def figures(rows: Sequence[Row]) -> Row:
    """What is counted of some insertions; ``good_refused`` ended in the gap by the ground truth, not claimed."""
    return {
        "insertions": len(rows),
        "claimed": sum(row["claimed"] for row in rows),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "inserted": sum(row["inserted"] for row in rows),
        "good_refused": sum(row["in_gap"] and not row["claimed"] for row in rows),
        "void": sum(row["void"] for row in rows),
    }


def report_of(rows: Sequence[Row], setup: Mapping[str, Any]) -> Row:
    """What the page is written from, as plain data."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        groups[_fault_of(row)].append(row)
    reasons = Counter(_short(row["reason"]) for row in rows if row["reason"])
    return {
        "simulated": True,
        "setup": dict(setup),
        "all": figures(rows),
        "faults": [{"fault": name, **figures(group)} for name, group in sorted(groups.items())],
        "reasons": [{"reason": reason, "insertions": count} for reason, count in reasons.most_common(20)],
    }


def _fault_of(row: Row) -> str:
    fault = row["fault"]
    return f"{fault['kind']}, {' and '.join(fault['fingers'])}" if fault else "no fault"


def _short(reason: str) -> str:
    return ": ".join(reason.split(": ")[:2]) if not reason.startswith("physics") else "physics"


def trust_page(data: Row) -> str:
    """The whole of docs/trust.md from trust.json."""
    every = data["all"]
    wrong = wilson(every["claimed_wrongly"], every["insertions"])
    truths = every["inserted"] + every["good_refused"]
    refused = wilson(every["good_refused"], truths) if truths else wilson(0, 0)
    return page(
        f"""
        # What a claim is worth, simulated

        Written by `make trust`: {every["insertions"]} insertions in lock step, each with its own draw of a world, an
        object, a start and, in half of them, a fault that lasts. The service, its networks, the controller and the
        client's machine are the shipped ones; markers are true ones with the tracker's error.

        **{every["claimed_wrongly"]} claims were not true: {wrong:.2%}** of all insertions, with the 95 % Wilson
        interval. Of {truths} insertions that ended in the gap, {every["good_refused"]} were not claimed: {refused:.1%}.
        Void are insertions in which the physics came to its end; they are neither claimed nor refused.
        """,
        data.get("note", ""),
        table(
            data["faults"],
            ("fault", "fault"),
            ("insertions", "insertions", "d"),
            ("claimed, not true", "claimed_wrongly", "d"),
            ("share", lambda row: wilson(row["claimed_wrongly"], row["insertions"]), ".1%"),
            ("claimed and true", "inserted", "d"),
            ("in the gap, not claimed", "good_refused", "d"),
            ("void", "void", "d"),
        ),
        "## How they ended that were not claimed",
        table(data["reasons"], ("reason", "reason"), ("insertions", "insertions", "d")),
    )


def write(rows: Sequence[Row], setup: Mapping[str, Any], docs: Path) -> str:
    """Write NAME.md and NAME.json into the folder; returns the text."""
    data = report_of(rows, setup)
    return publish(docs, NAME, trust_page(data), data)
