"""A new sensor is one file: it renders, is tracked, calibrated and collected with, and networks learn from it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional

from export.onnx.model import open_model
from export.onnx.to_onnx import export_checkpoint
from service.contract import ContractError, Sensor
from service.perception.markers.sequence import track_pairs
from service.tools.calibrate import fit_camera
from simulation.cli.dataset import CollectOptions, asked_manifest
from simulation.data.collect import Plan, make_shard
from simulation.data.dataset import Dataset, DatasetError, DatasetWriter
from simulation.data.lerobot import features
from simulation.optics.appearance import Appearance
from simulation.optics.renderer import Renderer
from simulation.scene.scene import SceneError
from simulation.scene.worlds import load_scene, load_world
from training.config import DataConfig
from training.data.batches import decisions
from training.data.dataset import load_trials
from training.data.labels import CLASSES
from training.fit.checkpoint import Checkpoint
from training.metrics.figures import Scales
from training.networks import build, reads
from training.networks.settings import NetworkConfig

THIRD = """
marker_rows = 12
marker_columns = 10
marker_pitch_px = 18.0
marker_diameter_px = 7.0
first_marker_px = [21.0, 17.5]
raw_width_px = 240
raw_height_px = 280
width_px = 204
height_px = 233
mm_per_px = 0.09
fps = 60
gel_width_mm = 17.0
gel_height_mm = 19.5
gel_margin_mm = [1.2, 0.8]
corners_raw_px = [[20.0, 15.0], [221.0, 14.0], [205.0, 262.0], [33.0, 261.0]]
"""


@pytest.fixture(scope="module", params=["gelsight_mini", "third"])
def profile(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Argument of the commands: the name of a profile, or a new file."""
    if request.param != "third":
        return str(request.param)
    path = tmp_path_factory.mktemp("sensors") / "third.toml"
    path.write_text(THIRD)
    return str(path)


@pytest.fixture(scope="module")
def collected(profile: str, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two collisions."""
    folder = tmp_path_factory.mktemp("collected")
    asked = asked_manifest(CollectOptions(folder, 2, ("circle",), profile, trials_per_shard=2))
    with DatasetWriter(folder, asked) as writer:
        writer.commit(make_shard(Plan(folder, "circle", 0, 2, 0, 0.0, sensor=asked.sensor)))
        assert writer.finish()
    return Dataset(folder)


def test_its_frames_are_tracked_to_a_quarter_of_a_pixel(collected: Dataset, profile: str) -> None:
    sensor = Sensor.load(profile)
    assert collected.manifest.sensor == sensor
    for index in range(len(collected)):
        trial, frames = collected.trial(index), collected.frames(index)
        grid = (2, sensor.marker_rows, sensor.marker_columns)
        assert trial.gel.shape == (30, *grid, 3)
        assert frames.shape == (8, 2, sensor.height_px, sensor.width_px, 3)
        tracked = track_pairs(frames, sensor.markers, sensor.fps)
        gel = trial.gel[trial.onset_frame : trial.onset_frame + 8, ..., :2].astype(np.float64)
        error = (tracked[7] - tracked[0])[..., :2] - (gel[7] - gel[0]) / sensor.mm_per_px
        visible = tracked[[0, 7], ..., 2].min(0) > 0
        assert visible.mean() > 0.8
        assert np.sqrt(np.square(error[visible]).mean()) < 0.25


def test_its_camera_is_calibrated_from_a_resting_gel(profile: str) -> None:
    sensor = Sensor.load(profile)
    renderer = Renderer(Appearance.draw(load_scene("circle", camera__sensor=profile), "right", 2))
    rest = np.zeros((sensor.marker_rows, sensor.marker_columns, 3), np.float32)
    still = np.median(np.stack([renderer.raw(rest, seed) for seed in range(5)]), axis=0).astype(np.uint8)
    fit = fit_camera(still, "right", sensor)
    assert (fit.camera.raw, fit.camera.rectified) == (sensor.raw, sensor.rectified)
    assert fit.residual_px < 0.5


@pytest.mark.parametrize("kind", [pytest.param("compact", marks=pytest.mark.slow), "markers"])
def test_a_network_of_its_size_trains_a_step(collected: Dataset, kind: str, tmp_path: Path) -> None:
    fit = kind == "markers"
    settings = NetworkConfig(kind=kind, front_width=8, trunk_width=8, feature_size=16, state_size=16, affine_fit=fit)
    trials = load_trials(DataConfig(path="", cache=str(tmp_path)), collected, reads(kind))
    torch.manual_seed(0)
    network = build(settings, len(CLASSES), trials.sensor)
    batch = decisions(trials, np.arange(2), None, pictures=True)
    network.set_scales(batch.fields)
    before = {name: value.clone() for name, value in network.named_parameters()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    fields = network.read_drawn(batch.drawn)
    assert fields.shape == network.normalised(batch.fields).shape
    loss = functional.cross_entropy(network.logits(network.read_fields(fields, batch.geometry)), batch.label)
    loss.backward()
    optimiser.step()
    moved = [name for name, value in network.named_parameters() if not torch.equal(value, before[name])]
    reader = "trunk.affine.read.weight" if fit else "front.cells.weight"
    assert {"direction.weight", "trunk.project.weight", reader} <= set(moved)
    assert all(torch.isfinite(value).all() for value in network.parameters())


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["compact", "markers"])
def test_its_networks_are_exported_with_its_card(profile: str, kind: str, tmp_path: Path) -> None:
    """Torch and ONNX agree, or the export refuses; frames of 240 px end in rows that fill no block of 11."""
    sensor = Sensor.load(profile)
    settings = NetworkConfig(kind=kind, front_width=8, trunk_width=8, feature_size=16, state_size=16)
    weights = build(settings, len(CLASSES), sensor).state_dict()
    fresh = Checkpoint("fresh", settings, weights, Scales(), Scales(), {}, "0" * 64, "none", sensor=sensor)
    fresh.save(tmp_path / "fresh.pt")
    assert Checkpoint.load(tmp_path / "fresh.pt").sensor == sensor
    (made,) = export_checkpoint(tmp_path / "fresh.pt", tmp_path, ("direction.step",))
    card = open_model(made).card
    assert (card.profile, card.frame) == (sensor, sensor.rectified)
    assert card.markers == (sensor.markers if kind == "markers" else None)


def test_what_it_collected_is_exported_in_its_sizes(collected: Dataset) -> None:
    sensor = collected.manifest.sensor
    listed = features(sensor)
    assert listed["observation.images.left"]["shape"] == [sensor.height_px, sensor.width_px, 3]
    assert listed["observation.gel"]["shape"] == [collected.trial(0).gel[0].size]


@pytest.mark.parametrize(
    ("collect", "message"),
    [
        (lambda out: asked_manifest(CollectOptions(out, sensor="gelsite_mini")), "--sensor: no sensor 'gelsite_mini'"),
        (
            lambda out: DatasetWriter(out, asked_manifest(CollectOptions(out, trials_per_shard=2))),
            "sensor is .*, asked for gelslim_2019",
        ),
    ],
)
def test_a_dataset_is_one_sensor_s(collected: Dataset, collect: Callable[[Path], object], message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        collect(collected.path)


def test_scenes_of_two_sensors_make_no_dataset(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    body = '[object]\nshape = "ellipse"\nsize_x_mm = 50.0\nsize_y_mm = 50.0\n[blocks]\ngap_mm = 54.0\n'
    mine.write_text(body + '[camera]\nsensor = "gelsight_mini"\n')
    assert load_scene(mine).fps == 25
    with pytest.raises(DatasetError, match="gelsight_mini, gelslim_2019: a dataset has one"):
        asked_manifest(CollectOptions(tmp_path, objects=("circle", str(mine))))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            "[camera.sensor]\nmarker_diametre_px = 6.0",
            "camera.sensor.marker_diametre_px: unknown key; did you mean 'mark",
        ),
        ('[camera]\nsensor = "gelsight"', "camera.sensor: no sensor 'gelsight': .*did you mean 'gelsight_mini'"),
    ],
)
def test_a_world_with_an_unknown_sensor_or_key_is_refused_by_file_and_name(
    tmp_path: Path, table: str, message: str
) -> None:
    (tmp_path / "world.toml").write_text(table)
    with pytest.raises(SceneError, match=rf"world\.toml: {message}"):
        load_world(tmp_path / "world.toml")


def test_a_picture_network_for_a_pitch_of_no_whole_blocks_is_refused_by_name() -> None:
    sensor = Sensor.model_validate(Sensor.load().model_dump() | {"name": "odd", "marker_pitch_px": 14.0})
    with pytest.raises(ContractError, match=r"sensor odd has markers 14 px apart; .* network\.kind = 'markers'"):
        build(NetworkConfig(), len(CLASSES), sensor)
    assert build(NetworkConfig(kind="markers"), len(CLASSES), sensor).reads_markers
