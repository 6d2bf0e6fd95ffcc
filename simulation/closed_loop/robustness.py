"""What the closed loop is disturbed with, one thing at a time, and the report of what that costs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from reporting.page import page, publish
from reporting.statistics import wilson
from reporting.table import table
from simulation.closed_loop.statistics import Row, ends, summarise, title_of
from simulation.scene.scene import Scene

NAME = "robustness"
NORMAL = "as trained"
ONLY_IN_PICTURES = {"gel.wear"}  # keys of the scene that change no marker's motion, only how it looks


@dataclass(frozen=True, slots=True)
class Condition:
    """One disturbance.

    ``factors`` multiply keys of the scene, ``values`` replace them, ``clearance_mm`` sets the gap, ``unstated`` is
    what nobody tells the software; ``dead`` is what ails the left finger's camera.
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    clearance_mm: float | None = None
    unstated: Mapping[str, Any] = field(default_factory=dict)
    dead: Literal["", "dark", "frozen"] = ""

    @property
    def only_in_pictures(self) -> bool:
        """Whether it disturbs pictures alone, so that it has to be played with them."""
        return bool(self.dead) or bool(self.values and set(self.values) <= ONLY_IN_PICTURES)

    def changes(self, scene: Scene) -> dict[str, Any]:
        """Dotted keys of the scene with their new values."""
        data = scene.model_dump()
        changes = dict(self.values)
        for key, factor in self.factors.items():
            part, name = key.split(".")
            changes[key] = data[part][name] * factor
        if self.clearance_mm is not None:
            changes["blocks.gap_mm"] = scene.object.size_x_mm + 2.0 * self.clearance_mm
        return changes


NOISE, MODULUS = "camera.noise_grey", "gel.shear_modulus_n_per_mm2"
CONDITIONS: Mapping[str, Condition] = {
    NORMAL: Condition(),
    "sensor noise x 0.25": Condition({NOISE: 0.25}),
    "sensor noise x 2": Condition({NOISE: 2.0}),
    "sensor noise x 4": Condition({NOISE: 4.0}),
    "block friction x 0.4": Condition({"blocks.friction": 0.4}),
    "block friction x 2": Condition({"blocks.friction": 2.0}),
    "gel friction x 0.7": Condition({"gel.friction": 0.7}),
    "gel friction x 1.4": Condition({"gel.friction": 1.4}),
    "gel stiffness x 0.6": Condition({MODULUS: 0.6}),
    "gel stiffness x 1.6": Condition({MODULUS: 1.6}),
    "block stiffness x 0.1": Condition({"blocks.stiffness_n_per_mm": 0.1}),
    "grip force x 0.7": Condition({"grasp.force_n": 0.7}),
    "grip force x 1.5": Condition({"grasp.force_n": 1.5}),
    "grasped 55 mm above the bottom": Condition(values={"grasp.height_mm": 55.0}),
    "clearance 1 mm": Condition(clearance_mm=1.0),
    "clearance 1.5 mm": Condition(clearance_mm=1.5),
    "clearance 4 mm": Condition(clearance_mm=4.0),
    "gel worn out": Condition(values={"gel.wear": 0.9}),
    "gap stated 4 mm too narrow": Condition(unstated={"told_gap_error_mm": -4.0}),
    "gap stated 4 mm too wide": Condition(unstated={"told_gap_error_mm": 4.0}),
    "5 % of frames dropped": Condition(values={"camera.dropped_share": 0.05}),
    "20 % of frames dropped": Condition(values={"camera.dropped_share": 0.2}),
    "left camera dark": Condition(dead="dark"),
    "left camera frozen": Condition(dead="frozen"),
}


def write(rows: list[Row], setup: Mapping[str, Any], docs: Path) -> str:
    """Write NAME.md and NAME.json into the folder; returns the text."""
    data = report_of(rows, setup)
    return publish(docs, NAME, robustness_page(data), data)


def report_of(rows: list[Row], setup: Mapping[str, Any]) -> Row:
    """What the page is written from, as plain data."""
    return {
        "simulated": True,
        "setup": dict(setup),
        "objects": sorted({title_of(row["scene"]) for row in rows}),
        "conditions": by_condition(rows),
        "summaries": summarise(rows),
    }


def by_condition(rows: Sequence[Row]) -> list[Row]:
    """All objects together, a row a tier and disturbance, in the order of `CONDITIONS`."""
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        tier, disturbance = str(row["condition"]).split(": ", 1)
        groups[tier, disturbance].append(row)
    return [
        {
            "tier": tier,
            "disturbance": disturbance,
            "perception": group[0]["perception"],
            **ends(group),
        }
        for disturbance in CONDITIONS
        for (tier, name), group in sorted(groups.items())
        if name == disturbance
    ]


def robustness_page(data: Row) -> str:
    """The whole of docs/robustness.md from robustness.json."""
    rows = data["conditions"]
    drawn = dict.fromkeys(row["disturbance"] for row in rows if row["perception"] == "pictures")
    fields = f"""
        Slip and markers come from the true marker field plus the tracker's measured error, which grows with the noise.
        With every frame drawn: {", ".join(drawn) or "none"}.
        """
    return page(
        f"""
        # Robustness of the closed loop, simulated

        Written by `make robustness`: one disturbance at a time, the belief controller with the shipped networks. They
        were trained on the `bristle` tier; the `layer` tier is a finer model of the gel that is new to them. Objects:
        {", ".join(data["objects"])}, together. A failure counts as 16 trials. Shares have their 95 % Wilson intervals.

        - Refused: the service or the client ended the insertion by itself instead of using up its trials.
        - Claimed wrongly: not in, but the client reported an insertion.
        - Void: the physics came to its end (no equilibrium, or an object pushed 12 mm up in the hand, from where on its
          grasp is not simulated). It counts as failed.
        """,
        data.get("note", ""),
        "Every frame was drawn, rectified and tracked."
        if all(row["perception"] == "pictures" for row in rows)
        else fields,
        table(
            rows,
            ("disturbance", "disturbance"),
            ("tier", "tier"),
            ("inserted", lambda row: f"{row['inserted']}/{row['insertions']}"),
            ("success", lambda row: wilson(row["inserted"], row["insertions"]), ".0%"),
            ("mean trials", "mean_trials", ".2f"),
            ("refused", "refused", "d"),
            ("claimed wrongly", "claimed_wrongly", "d"),
            ("void", "void", "d"),
        ),
    )


def label(tier: str, name: str) -> str:
    """The condition of a job: tier and disturbance."""
    return f"{tier}: {name}"
