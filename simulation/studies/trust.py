"""Claims under adversity: insertions with drawn faults, worlds, objects and starts, and the page of the claims.

The first figure is the number of false claims. A claim is only as good as the ground truth that it is compared with
(`simulation.scene.ground_truth`), so the page also counts the true insertions that were not claimed.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from reporting.page import page
from reporting.statistics import Estimate, clustered, wilson
from reporting.table import table
from service.contract import FINGERS, Finger
from simulation.closed_loop.benchmark import held_in
from simulation.closed_loop.campaign import Task
from simulation.closed_loop.job import job_in
from simulation.closed_loop.statistics import Row, claimed_wrongly
from simulation.closed_loop.true_fields import Fault, Kind
from simulation.scene.scene import Scene
from simulation.scene.worlds import World
from simulation.studies.lateness import errors_ms
from simulation.studies.wiring import MISTAKES

NAME = "trust"
FAULT_FREE, MISTAKEN = 0.45, 0.1  # shares of all insertions; the rest have a fault
KINDS: tuple[Kind, ...] = ("dark", "frozen", "stuck", "dropped")
BLIND: tuple[tuple[Finger, ...], ...] = (("left",), ("right",), FINGERS)
CONTACT_MM, DEEPEST_MM = 6.0, 24.0  # half of the faults begin before most objects touch, half on the way to full depth
WITHOUT = "no fault"


def tasks(
    worlds: Sequence[World],
    objects: Mapping[str, Scene],
    count: int,
    seed: int,
    models: Path,
    late_s: Mapping[str, float | None],
) -> list[Task]:
    """``count`` insertions, each with its own draw of world, object, start and fault; the same for the same seed.

    ``late_s``: lateness of each world by name, as its commissioning has measured it. Where it could not (None), the
    client refuses to insert: such a world is not drawn. Raises ValueError where that leaves none.
    """
    held = [{} if late_s.get(world.name, 0.0) is None else held_in(world, objects) for world in worlds]
    if not any(held):
        raise ValueError("no world in which an object can be held and the lateness was measured: nothing to play")
    rng = np.random.default_rng((seed, 0x7A57))
    todo: list[Task] = []
    while len(todo) < count:
        number = int(rng.integers(len(worlds)))
        name = list(objects)[int(rng.integers(len(objects)))]
        wrong, given = _fault(rng)
        shares = rng.uniform(-1.0, 1.0, 2)
        if name not in held[number]:
            continue  # the world was not timed, or this object cannot be held in it
        world, scene = worlds[number], held[number][name]
        start = (shares[0] * scene.x_range_mm, shares[1] * scene.theta_range_deg)
        job = job_in(world, name, len(todo), start, seed * 1_000_000 + len(todo), late_s=late_s.get(world.name))
        job["condition"] = f"{world.name}: {wrong}"
        if isinstance(given, Fault):
            job["fault"] = asdict(given) | {"fingers": list(given.fingers)}
        else:
            job["unstated"] = world.unstated.model_copy(update=given).model_dump(mode="json", exclude_defaults=True)
        todo.append(Task(models, job))
    return todo


def _fault(rng: np.random.Generator) -> tuple[str, Fault | Mapping[str, Any]]:
    """The fault by name: a fault on the way, a mistake of a first day, or nothing."""
    share = rng.random()
    if share < FAULT_FREE:
        return WITHOUT, {}
    if share < FAULT_FREE + MISTAKEN:
        name = list(MISTAKES)[int(rng.integers(len(MISTAKES)))]
        return name, MISTAKES[name]
    kind = KINDS[int(rng.integers(len(KINDS)))]
    fingers = FINGERS if kind == "dropped" else BLIND[int(rng.integers(len(BLIND)))]
    low_mm, high_mm = (-1.0, CONTACT_MM) if rng.random() < 0.5 else (CONTACT_MM, DEEPEST_MM)
    fault = Fault(kind, fingers, int(rng.integers(1, 3)), float(rng.uniform(low_mm, high_mm)))
    return f"{kind}, {' and '.join(fingers)}", fault


def figures(rows: Sequence[Row]) -> Row:
    """Counts of some insertions; ``good_refused`` ended in the gap by the ground truth, not claimed."""
    return {
        "insertions": len(rows),
        "claimed": sum(row["claimed"] for row in rows),
        "claimed_wrongly": sum(map(claimed_wrongly, rows)),
        "inserted": sum(row["inserted"] for row in rows),
        "good_refused": sum(row["in_gap"] and not row["claimed"] for row in rows),
        "void": sum(row["void"] for row in rows),
        "unseen_mm": max((row["unseen_mm"] for row in rows), default=0.0),
        "unseen_share": max((row["unseen_mm"] / (row["unseen_allowed_mm"] or 1.0) for row in rows), default=0.0),
    }


def report_of(rows: Sequence[Row], late: Sequence[Row], setup: Mapping[str, Any]) -> Row:
    """What the page is written from, as plain data. A fault that never came about counts as none.

    ``late``: rows of `lateness.lateness`.
    """
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        idle = row["fault"] and not row["fault_acted"]
        groups["fault that never came about" if idle else _wrong(row)].append(row)
    reasons = Counter(_short(row["reason"]) for row in rows if row["reason"])
    untrue = filter(claimed_wrongly, rows)
    keys = ("condition", "scene", "index", "seed", "shortfalls")
    worlds = {_world(row) for row in rows}
    return {
        "simulated": True,
        "setup": dict(setup),
        "worlds": len(worlds),
        "worlds_wrong": len({_world(row) for row in rows if claimed_wrongly(row)}),
        "all": figures(rows),
        "late": list(late),
        "untrue": [{key: row[key] for key in keys} for row in untrue],
        "refused": list(_refused(groups[WITHOUT])),
        "faults": [{"fault": name, **figures(group)} for name, group in sorted(groups.items())],
        "reasons": [{"reason": reason, "insertions": count} for reason, count in reasons.most_common(20)],
    }


def _refused(good: Sequence[Row]) -> Estimate:
    """Share of the insertions in the gap that were not claimed; its interval is as wide as the worlds differ."""
    worlds: dict[str, list[bool]] = defaultdict(list)
    for row in good:
        if row["in_gap"]:
            worlds[_world(row)].append(not row["claimed"])
    return clustered([sum(each) for each in worlds.values()], [len(each) for each in worlds.values()])


def _world(row: Row) -> str:
    return str(row["condition"].rpartition(": ")[0])


def _wrong(row: Row) -> str:
    return str(row["condition"].rpartition(": ")[2])


def _short(reason: str) -> str:
    return ": ".join(reason.split(": ")[:2]) if not reason.startswith("physics") else "physics"


def trust_page(data: Row) -> str:
    """The whole of docs/trust.md from trust.json."""
    return page(
        _result(data),
        *_untrue(data["untrue"]),
        """
        ## How it was measured

        Each insertion runs in lock step, with its own draw of a world, an object and a start. In 55 % of them something
        goes wrong as well: a persistent fault, or a commissioning mistake such as swapped cameras. The service, its
        networks, the controller and the client's state machine are those that ship. Marker positions are the true ones
        [plus the tracker's error](decisions/0018-closed-loop-in-lock-step.md#what-true-fields-leave-out). An insertion
        is void where the simulated physics found no solution; it counts neither
        as claimed nor as refused.
        """,
        _late(data["late"]),
        "## By fault",
        table(
            data["faults"],
            ("fault", "fault"),
            ("insertions", "insertions", "d"),
            ("false claims", "claimed_wrongly", "d"),
            ("share", lambda row: wilson(row["claimed_wrongly"], row["insertions"]), ".2%"),
            ("true claims", "inserted", "d"),
            ("in the gap, not claimed", "good_refused", "d"),
            ("void", "void", "d"),
            ("unseen mm", "unseen_mm", ".2f"),
            ("of allowed", "unseen_share", ".2f"),
        ),
        "## Why insertions were not claimed",
        table(data["reasons"], ("reason", "reason"), ("insertions", "insertions", "d")),
        data.get("note", ""),
        "`make trust` plays the test with another seed and writes this page.",
    )


def _result(data: Row) -> str:
    every, by_fault = data["all"], {row["fault"]: row for row in data["faults"]}
    wrong, insertions, claims = every["claimed_wrongly"], every["insertions"], every["claimed"]
    wrong_n, worlds_n = data["worlds_wrong"], data["worlds"]
    good = by_fault.get(WITHOUT, figures([]))
    truths = good["inserted"] + good["good_refused"]
    refused = Estimate(*data["refused"])
    return f"""
        # What a claim is worth, simulated

        **{wrong} of {claims} claims were false: {wilson(wrong, claims):.2%}**. That is {wilson(wrong, insertions):.2%}
        of {insertions} insertions. The upper end of the 95 % Wilson interval is the largest rate left possible. Whether
        claims can be false depends on the world: {wrong_n} of {worlds_n} had a false one,
        {wilson(wrong_n, worlds_n):.1%}.

        Without a fault, {truths} insertions ended in the gap, and {good["good_refused"]} of those were not claimed:
        {refused:.1%}; this interval is as wide as the worlds differ.

        After a frame that was judged, the arm descended by at most {every["unseen_mm"]:.2f} mm before the next one was
        judged or it stood, and in the worst case by {every["unseen_share"]:.2f} times what the lease allows at its
        speed.
        """


def _late(rows: Sequence[Row]) -> str:
    """How well each cell's lateness was known."""
    off_ms = errors_ms(rows)
    return f"""
        Each cell was [timed first](decisions/0194-how-late-pictures-and-arm-are.md), as in a commissioning. That gave a
        bound on the lateness of pictures and arm in {len(off_ms)} of {len(rows)} worlds, {np.mean(off_ms):+.0f} ms from
        the truth on average, {min(off_ms):+.0f} to {max(off_ms):+.0f} ms; in the others a client refuses to insert. The
        arm descends no faster than its lease then allows. The descent after a frame is counted from the frame's
        exposure, before its stamp.
        """


def _untrue(rows: Sequence[Row]) -> tuple[Any, ...]:
    """Each false claim, so that it can be replayed; nothing where there is none."""
    if not rows:
        return ()
    against = ("why it is false", lambda row: "; ".join(row["shortfalls"]) or "it has left the hand")
    return (
        "## False claims",
        table(rows, ("world and fault", "condition"), ("object", "scene"), ("seed", "seed", "d"), against),
    )
