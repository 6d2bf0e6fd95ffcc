"""Trials read as steps of depth, and a network trained on them."""

import json
from copy import copy
from multiprocessing import get_context

import numpy as np
import pytest
import torch

from service.contract import ContractError, Sensor
from service.perception.pressing import lattice_weights, on_lattice
from simulation.cli.dataset import export_dataset
from simulation.data import drawn_cells
from simulation.scene.rubber import shear_reach_pitches
from tests.simulation.strategies import made_up_dataset, made_up_trial
from tests.training.conftest import PRESSING, tiny
from tests.training.synthetic import SyntheticSource
from training.data import descents
from training.data.descents import Reader
from training.data.labels import CLASSES
from training.data.pressed import load_pressed
from training.data.reading import decisions
from training.fit.train import train
from training.networks import build
from training.networks.pressing import DECISION_STEPS, LATTICE, STEPS


def down(count):
    """Synthetic trials that go down by 0.15 mm a frame."""
    source = SyntheticSource(count, seed=3)
    for trial in source.trials:
        trial.onset_frame = 8
        trial.gel = np.roll(trial.gel, -10, 0)
        trial.gel[20:] = trial.gel[19]
        trial.depth_mm = np.arange(30) * 0.15
        trial.speed_mm_s, trial.grip_n, trial.shear_reach_mm = 12.0, 25.0, 0.6
    return source


@pytest.fixture(scope="module")
def pressed_source():
    """Sixty of them."""
    return down(60)


def test_views_are_the_same_in_every_process_and_differ_from_each_other(pressed_source, config):
    data = config.data.model_copy(update={"views": 2})
    first = load_pressed(data, pressed_source)
    again = load_pressed(data.model_copy(update={"cache": config.data.cache + "-2"}), pressed_source)
    assert np.array_equal(first.fields, again.fields)
    train_rows = first.of("train")
    assert len(train_rows) == 2 * sum(trial.split == "train" for trial in pressed_source.trials)
    assert not np.array_equal(first.fields[train_rows[0]], first.fields[train_rows[1]])
    assert first.fields.shape[1:] == (STEPS, 2, LATTICE.rows, LATTICE.columns, 2)


@pytest.mark.parametrize(("axis", "named"), [("x_mm", "x"), ("theta_deg", "yaw")])
def test_presses_of_one_error_alone_are_refused_before_the_training(config, axis, named):
    """Their card would state a spread of 0, which no loader of the checkpoint accepts."""
    source = down(20)
    for trial in source.trials:
        setattr(trial, axis, 3.0)
    data = config.data.model_copy(update={"cache": config.data.cache + named})
    with pytest.raises(ContractError, match=f"all training errors in {named} are the same"):
        train(config.model_copy(update={"network": PRESSING, "data": data}), source)
    assert not (config.folder / "config.json").exists()


def test_two_processes_may_fill_the_same_cache_at_once(pressed_source, config, tmp_path, monkeypatch):
    data = config.data.model_copy(update={"cache": str(tmp_path)})
    write = np.savez

    def overtaken(path, **table):
        write(path, **table)
        monkeypatch.setattr(np, "savez", write)
        other = get_context("fork").Process(target=load_pressed, args=(data, pressed_source))
        other.start()
        other.join()
        assert other.exitcode == 0

    monkeypatch.setattr(np, "savez", overtaken)
    assert len(load_pressed(data, pressed_source)) > 60
    assert len(list(tmp_path.rglob("*.npz"))) == 1


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        ({"split": "test"}, "re-fixture group rectangle/0"),
        ({"gel": np.full((30, 2, 20, 21, 3), np.nan)}, "trial 1: gel is not finite"),
        ({"depth_mm": np.full(30, np.nan)}, "trial 1: depth_mm is not finite"),
    ],
    ids=["a group in two splits", "a gel of NaN", "depths of NaN"],
)
def test_presses_that_would_spoil_a_network_or_its_figures_are_refused(config, tmp_path, damage, named):
    source = down(10)
    for name, value in damage.items():
        setattr(source.trials[1], name, value)
    with pytest.raises(ContractError, match=named):
        load_pressed(config.data.model_copy(update={"cache": str(tmp_path)}), source)


def test_a_trial_that_states_no_speed_is_read_as_one_of_its_scene(pressed_source):
    stated, silent = copy(pressed_source.trials[0]), copy(pressed_source.trials[0])
    stated.speed_mm_s, silent.speed_mm_s = 10.0, 0.0
    reader = Reader(pressed_source.manifest.sensor)
    views = [reader.view(reader.stored(trial), np.random.default_rng(4)) for trial in (stated, silent)]
    np.testing.assert_array_equal(views[0][0], views[1][0])
    assert views[0][1:] == views[1][1:]


def test_descents_that_are_read_otherwise_share_no_table(pressed_source, config, monkeypatch):
    before = load_pressed(config.data, pressed_source)
    monkeypatch.setattr(descents, "TRACKING_MM", (0.02, 0.03))
    assert not np.array_equal(load_pressed(config.data, pressed_source).fields, before.fields)


@pytest.mark.parametrize("name", ["gelslim_2019", "gelsight_mini"])
def test_a_point_is_visible_in_training_where_it_is_in_the_service(name):
    sensor = Sensor.load(name)
    trial = copy(down(1).trials[0])
    trial.gel = np.ones((30, 2, sensor.marker_rows, sensor.marker_columns, 3)) * np.arange(30).reshape(30, 1, 1, 1, 1)
    reader = Reader(sensor)
    steps, length, _ = reader.view(reader.stored(trial), np.random.default_rng(1))
    centre = np.array([0.5 * (sensor.width_px - 1), 0.5 * (sensor.height_px - 1)], np.float32)
    rest_mm = (sensor.marker_rest_px().reshape(-1, 2) - centre) * np.float32(sensor.mm_per_px)
    weights = lattice_weights(rest_mm, LATTICE, sensor.marker_pitch_mm)
    served = on_lattice(np.zeros_like(rest_mm), np.ones(len(rest_mm), bool), weights)[:, 2] > 0
    visible = np.isfinite(steps[:length]).all(-1).reshape(-1, served.size)
    assert (visible == served).all()


def test_a_batch_is_told_less_in_training_and_all_it_was_told_otherwise(pressed_source, config):
    samples = load_pressed(config.data, pressed_source)
    chosen = samples.of("train")
    assert (samples.conditions[chosen] > 0).all()
    batch = decisions(samples, chosen, np.random.default_rng(0), pictures=False)
    assert 0.2 < float((batch.geometry[:, 3] == 0).float().mean()) < 0.6
    assert float((batch.geometry[:, 4] == 0).float().mean()) == 0.0
    still = decisions(samples, chosen, None, pictures=False)
    assert np.array_equal(still.geometry.numpy(), samples.conditions[chosen])


@pytest.fixture(scope="module")
def run(pressed_source, cache, tmp_path_factory):
    """A tiny run on these trials that is done: its config and its checkpoint."""
    config = tiny(tmp_path_factory.mktemp("pressed"), cache).model_copy(update={"network": PRESSING})
    return config, train(config, pressed_source)


def test_a_run_states_how_it_reads_and_what_it_was_trained_on(run):
    _, checkpoint = run
    assert checkpoint.pressing is not None
    assert checkpoint.pressing.steps_n == DECISION_STEPS
    assert checkpoint.pressing.strangeness_limit > 0
    speed = checkpoint.pressing.trained["speed_mm_s"]
    assert 11.0 < speed.low <= speed.high < 13.0
    assert checkpoint.figures["validation/all"]["trials"] > 0


def test_training_moves_every_weight_but_those_that_are_fixed(pressed_source, run):
    config, checkpoint = run
    torch.manual_seed(config.seed)
    begun = build(PRESSING, len(CLASSES), pressed_source.manifest.sensor)
    kept = [name for name, value in begun.named_parameters() if torch.equal(value, checkpoint.weights[name])]
    assert kept == ["shares.weight", "shares.bias"]
    assert not any(begun.get_parameter(name).requires_grad for name in kept)


def test_a_network_is_trained_on_a_lerobot_export_as_on_the_shards_it_is_of(tmp_path, config):
    trials = [
        made_up_trial(
            k,
            gel=made_up_trial(k).gel * np.float16(3),
            group=k,
            onset_frame=8,
            drawn="{}",
            speed_mm_s=10.0,
            grip_n=20.0,
        )
        for k in range(6)
    ]
    made_up_dataset(tmp_path / "shards", trials)
    assert export_dataset([str(tmp_path / "shards"), "--out", str(tmp_path / "lerobot")]) == 0
    runs = {
        name: config.model_copy(
            update={
                "network": PRESSING,
                "runs": str(tmp_path / name / "runs"),
                "data": config.data.model_copy(update={"path": str(tmp_path / name)}),
            }
        )
        for name in ("shards", "lerobot")
    }
    one, other = (train(run) for run in runs.values())
    assert one.weights_sha256() == other.weights_sha256()
    assert one.figures == other.figures


def test_a_drawn_cell_says_all_that_was_drawn():
    scene, drawn = drawn_cells.draw_cell(np.random.default_rng(4))
    changes, stated = json.loads(drawn), drawn_cells.stated(scene)
    assert changes["gel.shear_modulus_n_per_mm2"] == scene.gel.shear_modulus_n_per_mm2
    assert changes["camera.fps"] == scene.fps
    assert changes["world.camera_roll_deg"]
    assert stated["shear_reach_mm"] == pytest.approx(1.05 * shear_reach_pitches(scene))
    assert stated["speed_mm_s"] == changes["motion.descent_speed_mm_s"]
