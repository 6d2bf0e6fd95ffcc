"""The wiring check in lock step: four probes at known errors, before a cell may insert anything."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from robot_client.session.commission.wiring import SIDES, WENT_IN, Probe, dangerous_mistakes, mistakes
from simulation.closed_loop.job import job_in
from simulation.closed_loop.lockstep import hash_seed
from simulation.closed_loop.statistics import Row
from simulation.scene.scene import Scene
from simulation.scene.shapes import half_width_mm
from simulation.scene.worlds import World

SIGNS = 4
"""Separates the seeds of these probes from those of everything else that is played in a cell."""
MISTAKES: Mapping[str, Mapping[str, Any]] = {
    "fingers swapped": {"swapped_fingers": True},
    "left mirrored": {"mirrored": (True, False)},
    "right mirrored": {"mirrored": (False, True)},
    "both mirrored": {"mirrored": (True, True)},
    "x reversed": {"x_sign": -1},
    "yaw reversed": {"yaw_sign": -1},
}
"""Mistakes of a first day: the change of each in a world's table `[world]`."""
BEFORE_SIGNS: Mapping[str, Any] = {"purpose": "probe", "commissioned": False}
"""Fields of a `Job` that is played before the signs are known."""


def mistaken(world: World) -> Iterator[World]:
    """The world with each mistake of a first day."""
    for name, changed in MISTAKES.items():
        yield replace(world, name=f"{world.name}, {name}", unstated=world.unstated.model_copy(update=changed))


def by_corner(objects: Mapping[str, Scene]) -> list[str]:
    """Their names, the one whose first corner to touch lies farthest out in x and y first: it tells the yaw best.

    That corner is half the width away in x. In y it is away by what a turn adds to the width, over the turn. Objects
    whose gap is so wide that they go in from such an error come last: they touch nothing.
    """

    def place(name: str) -> tuple[bool, float]:
        scene = objects[name]
        straight_mm, turned_mm = (half_width_mm(scene.object.footprint_mm, deg) for deg in (0.0, SIDES[0][1]))
        return not _goes_in(scene), straight_mm * (turned_mm - straight_mm)

    return sorted(objects, key=place, reverse=True)


def probes(world: World, name: str, seed: int, **job: Any) -> list[Row]:
    """Jobs of the four probes with an object, as an arm with reversed axes carries it; ``job``: fields of `Job`."""
    arm = world.unstated
    starts = [(x_mm * arm.x_sign, theta_deg * arm.yaw_sign) for x_mm, theta_deg in SIDES]
    return [
        job_in(world, name, index, start, hash_seed(seed, SIGNS, world.number, index), **{**job, **BEFORE_SIGNS})
        for index, start in enumerate(starts)
    ]


def carried_out(rows: Sequence[Row]) -> bool:
    """Whether each of these probes was answered or inserted; one that was refused in its grasp tells nothing."""
    return not any(row["reason"] and not row["trials"] for row in rows)


def touched(rows: Sequence[Row]) -> bool:
    """Whether these probes were carried out and felt a block: an object that goes in tells nothing of the wiring."""
    return carried_out(rows) and any(row["trials"] for row in rows)


def felt_nothing(rows: Sequence[Row], scene: Scene) -> list[str]:
    """The mistake of a cell in which these probes felt no block at errors from which the object cannot go in."""
    if touched(rows) or not carried_out(rows) or _goes_in(scene):
        return []
    return named_mistakes(rows)


def hung_turned(rows: Sequence[Row]) -> list[str]:
    """The mistake of a cell in which the object hung turned in the hand before each of these descents."""
    if not all("turned_in_hand" in row["reason"] and not row["trials"] for row in rows):
        return []
    return ["the object hung turned before each descent: are the block tops higher than taught, or is it too heavy?"]


def _goes_in(scene: Scene) -> bool:
    return any(scene.fits(*side) for side in SIDES)


def named_mistakes(rows: Sequence[Row]) -> list[str]:
    """Mistakes of the cell from these four probes, by the client's own rule; empty unless all were carried out."""
    return list(mistakes(_sides(rows))) if carried_out(rows) else []


def named_wirings(rows: Sequence[Row]) -> list[str]:
    """As `named_mistakes`, but only those by which corrections or claims are wrong, not what is out of place."""
    return list(dangerous_mistakes(_sides(rows))) if carried_out(rows) else []


def _sides(rows: Sequence[Row]) -> tuple[Probe, ...]:
    return tuple(_probe(row, *side) for row, side in zip(rows, SIDES, strict=True))


def _probe(row: Row, x_mm: float, theta_deg: float) -> Probe:
    """The client's record of a probe that it took for one at this error."""
    decision = row["trials"][0]["decision"] if row["trials"] else {}
    felt, turns = decision.get("estimate") or {}, decision.get("turns_deg")
    ending = f"{decision['reason']}: {decision['detail']}" if "detail" in decision else WENT_IN
    return Probe(
        x_mm=x_mm,
        theta_deg=theta_deg,
        estimate_x_mm=felt.get("dx_mm"),
        estimate_theta_deg=felt.get("dtheta_deg"),
        sigma_x_mm=felt.get("sigma_x_mm"),
        sigma_theta_deg=felt.get("sigma_theta_deg"),
        turns_deg=turns and (turns[0], turns[1]),
        below_mm=row["trials"][0].get("below_mm") if row["trials"] else None,
        said="" if felt else ending,
        insertion_id="simulated",
    )
