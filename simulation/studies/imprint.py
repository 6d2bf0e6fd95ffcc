"""The simulated sensor's pictures, object by object, for comparison with a real one."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from reporting.figure import drawing
from simulation.data.probe import run_probe
from simulation.optics import attempt_picture
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.worlds import load_scene

X_MM, THETA_DEG, SEED = 8.0, 6.0, 1
COLUMNS = ("raw, held", "raw, after the collision", "rectified, after", "difference", "motion")


@dataclass(frozen=True, slots=True)
class Options:
    """Poke with each object once and draw the left finger: raw, rectified, difference, motion of the markers."""

    out: Path = Path("docs/imprint.png")
    """PNG file to write."""
    objects: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ("rectangle", "circle", "vitamin")
    """Scenes to show, one per row."""


def _row(axes: Sequence[Any], name: str) -> None:
    scene = load_scene(name)
    probe = run_probe(scene, X_MM, THETA_DEG, seed=SEED)
    renderer = Renderer(Appearance.draw(scene, "left", SEED))
    before, after = (probe.gel[k, 0].astype(np.float32) for k in (0, -1))
    held, pressed = renderer.raw(before, 0), renderer.raw(after, 1)
    flat = renderer.rectify(pressed)
    change = 128 + 2 * (flat.astype(np.int16) - renderer.rectify(held))
    images = [held, pressed, flat, np.clip(change, 0, 255).astype(np.uint8)]
    for panel, image in zip(axes, images, strict=False):
        panel.imshow(image[..., ::-1])
    motion_px = (after - before)[..., :2] / scene.sensor.mm_per_px
    attempt_picture.imprint(axes[-1], flat, "", (scene.sensor.marker_rest_px(), motion_px))
    for panel in axes:
        panel.set_xticks([])
        panel.set_yticks([])
    axes[0].set_ylabel(scene.name)


def draw(options: Options) -> None:
    rows, columns = len(options.objects), len(COLUMNS)
    with drawing(options.out, rows, columns, size=(16, 2.9 * rows), dpi=60) as panels:
        for axes, name in zip(panels, options.objects, strict=True):
            _row(axes, name)
        for axes, title in zip(panels[0], COLUMNS, strict=True):
            axes.set_title("\n".join(filter(None, (title, axes.get_title()))))
