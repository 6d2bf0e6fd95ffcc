"""Every key of a sensor's profile has its documented effect."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from service.contract import Sensor
from service.perception.markers.field import MarkerField, field_from_gel
from service.perception.markers.lattice import find_lattice
from service.perception.markers.tracker import MarkerTracker
from service.perception.rectification import Rectifier
from simulation.data.probe import Probe, QuasiStaticCell, run_probe
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.physics.pads import pad_of
from simulation.physics.readout import Readout
from simulation.scene.effects import active_effects
from simulation.scene.scene import Scene
from simulation.scene.worlds import load_scene
from tests.service import tiny_models

USUAL = Sensor.load()
STILL = {"effects__camera_noise": "off", "effects__gel_wear": "off"}


@cache
def scene(sensor: Sensor) -> Scene:
    return load_scene("circle", camera__sensor=sensor, **STILL)


@cache
def renderer(sensor: Sensor) -> Renderer:
    return Renderer(Appearance.draw(scene(sensor), "left", 1))


def gel(sensor: Sensor, du_mm: float = 0.0) -> np.ndarray:
    state = np.zeros((sensor.marker_rows, sensor.marker_columns, 3), np.float32)
    state[..., 0] = du_mm
    return state


@cache
def tracked(sensor: Sensor, du_mm: float = 0.0) -> MarkerField:
    """The service's tracking of a gel that moves by du_mm as a whole, from raw frames."""
    tracker, drawing = MarkerTracker(), renderer(sensor)
    rectifier = Rectifier(drawing.calibration)
    tracker.update(rectifier.apply(drawing.raw(gel(sensor), 0)), 0)
    return tracker.update(rectifier.apply(drawing.raw(gel(sensor, du_mm), 1)), round(1e9 / sensor.fps))


@cache
def probe(sensor: Sensor) -> Probe:
    return run_probe(scene(sensor), 6.0, 3.0)


def rest(sensor: Sensor) -> np.ndarray:
    field = tracked(sensor)
    return field.rest_px[field.rest_px.shape[0] // 2, field.rest_px.shape[1] // 2]


def name(usual: Sensor, other: Sensor) -> None:
    ours, theirs = (
        tiny_models.card("direction", "step").model_copy(update={"sensor": sensor}) for sensor in (usual, other)
    )
    assert other.name in str(ours.disagreements(theirs))


def markers(usual: Sensor, other: Sensor) -> None:
    for sensor in (usual, other):
        grid = (sensor.marker_rows, sensor.marker_columns)
        assert tracked(sensor).valid.shape == probe(sensor).gel.shape[2:4] == probe(sensor).slipping.shape[2:4] == grid


def marker_pitch_px(usual: Sensor, other: Sensor) -> None:
    assert tracked(other).pitch_px / tracked(usual).pitch_px == pytest.approx(14.0 / 15.0, rel=2e-3)
    motion = [probe(sensor).gel[-1, 0, 0] for sensor in (usual, other)]
    assert not np.array_equal(*motion)  # the physics, too: it is read elsewhere on the gel
    assert field_from_gel(gel(other), 0, other).pitch_px == 14.0


def marker_diameter_px(usual: Sensor, other: Sensor) -> None:
    dark = [
        float((renderer(sensor).rectified(gel(sensor), 0)[40:280, 40:280].min(-1) < 60).mean())
        for sensor in (usual, other)
    ]
    assert dark[1] > 1.5 * dark[0]
    lattices = [find_lattice(renderer(sensor).rectified(gel(sensor), 0)) for sensor in (usual, other)]
    assert lattices[1].diameter_px > lattices[0].diameter_px


def first_marker_px(usual: Sensor, other: Sensor) -> None:
    moved = np.subtract(other.first_marker_px, usual.first_marker_px)
    np.testing.assert_allclose(rest(other) - rest(usual), moved, atol=0.1)
    assert np.array_equal(field_from_gel(gel(other), 0, other).rest_px[0, 0], np.float32(other.first_marker_px))


def raw_size(usual: Sensor, other: Sensor) -> None:
    shapes = [renderer(sensor).raw(gel(sensor), 0).shape for sensor in (usual, other)]
    assert shapes == [sensor.raw.shape for sensor in (usual, other)]
    assert shapes[0] != shapes[1]
    assert renderer(other).calibration.raw == other.raw


def rectified_size(usual: Sensor, other: Sensor) -> None:
    shapes = [renderer(sensor).rectified(gel(sensor), 0).shape for sensor in (usual, other)]
    assert shapes == [sensor.rectified.shape for sensor in (usual, other)]
    assert shapes[0] != shapes[1]


def mm_per_px(usual: Sensor, other: Sensor) -> None:
    for sensor in (usual, other):
        moved = np.median(tracked(sensor, 0.35).displacement_px[..., 0])
        assert moved == pytest.approx(0.35 / sensor.mm_per_px, abs=0.1)
        drawn = field_from_gel(gel(sensor, 0.35), 0, sensor).displacement_px[0, 0, 0]
        assert drawn == pytest.approx(0.35 / sensor.mm_per_px, rel=1e-5)


def fps(usual: Sensor, other: Sensor) -> None:
    for sensor in (usual, other):
        steps = np.diff(probe(sensor).depth_mm)
        assert steps.max() == pytest.approx(scene(sensor).speed_mm_s / sensor.fps)


def gel_size(usual: Sensor, other: Sensor) -> None:
    """A pad of another size under the same grip is pressed otherwise; its nodes share its area."""
    area = [sensor.gel_width_mm * sensor.gel_height_mm for sensor in (usual, other)]
    cells = [QuasiStaticCell(scene(sensor)) for sensor in (usual, other)]
    nodes = [float(cell.constants["area"][0]) for cell in cells]
    assert nodes[1] / nodes[0] == pytest.approx(area[1] / area[0])
    assert not np.array_equal(*(cell.look().gel for cell in cells))


def gel_margin_mm(usual: Sensor, other: Sensor) -> None:
    """Stretch that grows across the pad is read where the markers are."""
    read = []
    for sensor in (usual, other):
        rows, columns = scene(sensor).gel.node_rows, scene(sensor).gel.node_columns
        u, v = np.meshgrid(
            np.arange(columns) * sensor.gel_width_mm / columns, np.arange(rows) * sensor.gel_height_mm / rows
        )
        stretch = np.tile(np.stack([u.ravel(), -v.ravel()], 1), (2, 1))
        read.append(
            Readout(scene(sensor), pad_of(scene(sensor), active_effects(scene(sensor))), coupled=False)(
                stretch, np.zeros(len(stretch))
            )[0, 9, 10, :2]
        )
    np.testing.assert_allclose(read[1] - read[0], np.subtract(other.gel_margin_mm, usual.gel_margin_mm), atol=1e-4)


def corners_raw_px(usual: Sensor, other: Sensor) -> None:
    raw = [renderer(sensor).raw(gel(sensor), 0).astype(int) for sensor in (usual, other)]
    assert np.abs(raw[0] - raw[1]).mean() > 5.0
    np.testing.assert_allclose(rest(other), rest(usual), atol=0.1)  # the rectifier takes it back


CLAIMS: dict[str, tuple[dict[str, Any], Callable[[Sensor, Sensor], None]]] = {
    "name": ({}, name),
    "marker_rows": ({"marker_rows": 18}, markers),
    "marker_columns": ({"marker_columns": 19}, markers),
    "marker_pitch_px": ({"marker_pitch_px": 14.0}, marker_pitch_px),
    "marker_diameter_px": ({"marker_diameter_px": 7.5}, marker_diameter_px),
    "first_marker_px": ({"first_marker_px": (10.0, 19.0)}, first_marker_px),
    "raw_width_px": ({"raw_width_px": 450}, raw_size),
    "raw_height_px": ({"raw_height_px": 330}, raw_size),
    "width_px": ({"width_px": 335}, rectified_size),
    "height_px": ({"height_px": 325}, rectified_size),
    "mm_per_px": ({"mm_per_px": 0.06}, mm_per_px),
    "fps": ({"fps": 60}, fps),
    "gel_width_mm": ({"gel_width_mm": 24.0}, gel_size),
    "gel_height_mm": ({"gel_height_mm": 23.0}, gel_size),
    "gel_margin_mm": ({"gel_margin_mm": (0.3, 0.6)}, gel_margin_mm),
    "corners_raw_px": (
        {"corners_raw_px": ((50.0, 20.0), (390.0, 20.0), (330.0, 300.0), (90.0, 300.0))},
        corners_raw_px,
    ),
}


@pytest.mark.parametrize("key", Sensor.model_fields)
def test_a_key_changes_what_it_says(key: str) -> None:
    values, claim = CLAIMS[key]
    claim(USUAL, Sensor.model_validate(USUAL.model_dump() | {"name": "changed"} | values))


@pytest.mark.parametrize("key", sorted(set(Sensor.model_fields) - {"name"}))
def test_a_key_is_part_of_what_data_sets_know_a_scene_by(key: str) -> None:
    values, _ = CLAIMS[key]
    assert scene(USUAL).varied({f"camera.sensor.{k}": v for k, v in values.items()}).identity_json() != (
        scene(USUAL).identity_json()
    )
