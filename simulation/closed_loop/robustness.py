"""What the closed loop is disturbed with, one thing at a time, and the report of what that costs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from simulation.closed_loop.statistics import Row, refused, summarise, title_of, trials_of, wilson
from simulation.scene.scene import Scene

NAME = "robustness"
NORMAL = "as trained"
ONLY_IN_PICTURES = {"gel.wear"}  # keys of the scene that change no marker's motion, only how it looks


@dataclass(frozen=True, slots=True)
class Condition:
    """One disturbance.

    ``factors`` multiply keys of the scene, ``values`` replace them, ``clearance_mm`` sets the gap, ``gap_error_mm`` is
    added to the gap width that the client states; ``dead`` is what ails the left finger's camera.
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    values: Mapping[str, Any] = field(default_factory=dict)
    clearance_mm: float | None = None
    gap_error_mm: float = 0.0
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
    "gap stated 4 mm too narrow": Condition(gap_error_mm=-4.0),
    "gap stated 4 mm too wide": Condition(gap_error_mm=4.0),
    "5 % of frames dropped": Condition(values={"camera.dropped_share": 0.05}),
    "20 % of frames dropped": Condition(values={"camera.dropped_share": 0.2}),
    "left camera dark": Condition(dead="dark"),
    "left camera frozen": Condition(dead="frozen"),
}


def write(rows: list[Row], setup: Mapping[str, Any], docs: Path) -> str:
    """Write NAME.md and NAME.json into the folder; returns the text."""
    docs.mkdir(parents=True, exist_ok=True)
    text = report(rows)
    (docs / f"{NAME}.md").write_text(text, encoding="utf-8")
    data = {"simulated": True, "setup": dict(setup), "summaries": summarise(rows)}
    (docs / f"{NAME}.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    return text


def report(rows: list[Row]) -> str:
    """Success and trials by condition and tier, all objects together, as Markdown."""
    tiers = sorted({tier_of(row) for row in rows})
    scenes = sorted({title_of(row["scene"]) for row in rows})
    heads = [f"{tier} tier: inserted, 95 % interval, mean trials, refused, claimed wrongly, void" for tier in tiers]
    lines = [
        "# Robustness of the closed loop, simulated",
        "",
        "Written by `make robustness`: one disturbance at a time, the belief controller with the shipped networks,",
        "which were trained on the `bristle` tier; the `layer` tier is a finer model of the gel that they never saw.",
        f"Objects: {', '.join(scenes)}, together. A failure counts as 16 trials. Refused: insertions in which the",
        "service or the client ended the insertion by itself instead of using up its trials. Claimed wrongly: not in,",
        "but the client claimed it. Void: the physics came to its end (no equilibrium,",
        "or an object pushed 12 mm up in the hand, from where on its grasp is not simulated); it counts as failed.",
        *_perception(rows),
        "",
        "| disturbance | " + " | ".join(heads) + " |",
        "|---" * (len(tiers) + 1) + "|",
    ]
    for name in CONDITIONS:
        cells = [_cell([r for r in rows if tier_of(r) == tier and name_of(r) == name]) for tier in tiers]
        if any(cells):
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def _perception(rows: Sequence[Row]) -> list[str]:
    """What perception looked at, where it was not every picture everywhere."""
    drawn = {name_of(row) for row in rows if row["perception"] == "pictures"}
    if len(drawn) == len({name_of(row) for row in rows}):
        return ["Every frame was drawn, rectified and tracked."]
    listed = ", ".join(name for name in CONDITIONS if name in drawn) or "none"
    return [
        "Slip and markers are taken from the true marker field plus the tracker's measured error, which grows with the",
        f"noise; with every frame drawn: {listed}.",
    ]


def label(tier: str, name: str) -> str:
    """The condition of a job: tier and disturbance."""
    return f"{tier}: {name}"


def tier_of(row: Row) -> str:
    """Tier of a row's condition."""
    return str(row["condition"]).split(": ", 1)[0]


def name_of(row: Row) -> str:
    """Disturbance of a row's condition."""
    return str(row["condition"]).split(": ", 1)[1]


def _cell(rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    inserted = sum(row["inserted"] for row in rows)
    low, high = wilson(inserted, len(rows))
    mean = sum(trials_of(row) for row in rows) / len(rows)
    wrong = sum(row["claimed"] and not row["inserted"] for row in rows)
    void = sum(row["void"] for row in rows)
    ended = sum(refused(row) for row in rows)
    return f"{inserted}/{len(rows)}, {low:.0%} .. {high:.0%}, {mean:.2f}, {ended}, {wrong}, {void}"
