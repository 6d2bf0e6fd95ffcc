"""The last pictures of each failed insertion of the sealed test: replayed and drawn."""

import sys
import textwrap
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reporting.figure import drawing
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import models_of, stage
from simulation.closed_loop.statistics import Row
from simulation.scene.state import PhysicsError
from simulation.studies.witness.sealed_page import cause

ACROSS, MOST = 3, 6
Image = NDArray[np.uint8]


def draw(rows: Sequence[Row], models: Path, file: Path) -> None:
    """Write both fingers' last frames of failed rows, each under its world and cause, to a PNG.

    If there are many, the first ones, false claims before all others.
    """
    rows = sorted(rows, key=lambda row: not row["claimed"])[:MOST]
    down = -(-len(rows) // ACROSS)
    with drawing(file, down, ACROSS, size=(11, 2.0 * down)) as panels:
        for panel in panels.flat:
            panel.axis("off")
        for done, (panel, row) in enumerate(zip(panels.flat, rows, strict=False)):
            sys.stderr.write(f"{done}/{len(rows)} failures played again\n")
            panel.imshow(_last_frames(row, models)[..., ::-1])
            world = row["condition"].partition(":")[0]
            why = textwrap.shorten(row["reason"] or cause(row), 100)
            panel.set_title(f"{world}\n{textwrap.fill(why, 58)}", fontsize=7)


def _last_frames(row: Row, models: Path) -> Image:
    """Left and right side by side, uint8 [h, 2 w, 3] BGR."""
    job = Job(**{field.name: row[field.name] for field in fields(Job)})
    try:
        insertion = stage(job, models_of(models))
        insertion.run()
    except PhysicsError:  # it could not even be grasped
        sensor = job.build_scene().sensor
        return np.zeros((sensor.raw_height_px, 2 * sensor.raw_width_px, 3), np.uint8)
    return np.hstack([insertion.cell.picture_later(index)() for index in range(2)])
