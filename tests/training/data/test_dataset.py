from dataclasses import replace

import numpy as np
import pytest

from service.contract import ContractError, Sensor
from tests.full_disk import files_of_at_most
from tests.simulation.strategies import made_up_dataset, made_up_trial
from tests.training.synthetic import SyntheticSource
from training.config import WINDOW, DataConfig
from training.data.batches import decisions, mirror_fields
from training.data.dataset import load_trials, reader_sha256
from training.data.labels import class_of
from training.networks.preprocessing import pool_frames
from training.networks.settings import FRAMES_PER_DECISION

SENSOR = Sensor.load()


@pytest.fixture(scope="module")
def small():
    return SyntheticSource(30, seed=3)


@pytest.fixture(scope="module")
def drawing(tmp_path_factory):
    cache = str(tmp_path_factory.mktemp("cache"))
    return DataConfig(path="unused", cache=cache, rendered_training=2, rendered_validation=1, rendered_test=1)


@pytest.fixture(scope="module")
def trials(small, drawing):
    return load_trials(drawing, small)


def _counting(small, calls):
    def draws(index, start, count):
        calls.append(index)
        return SyntheticSource.frames(small, index, start, count)

    return draws


def test_the_cache_returns_what_was_read(trials, drawing, small, monkeypatch):
    calls: list[int] = []
    monkeypatch.setattr(small, "frames", _counting(small, calls))
    again = load_trials(drawing, small)
    assert calls == [0]  # one pair of pictures tells that the renderer is the same; none is drawn for training
    for name in ("error", "fields", "picture", "drawn"):
        assert np.array_equal(getattr(trials, name), getattr(again, name))


@pytest.mark.parametrize("kept", [0, 0.5], ids=["empty", "half"])
@pytest.mark.parametrize("kind", ["table", "drawn"])
def test_a_damaged_file_of_the_cache_is_named(small, tmp_path, kind, kept):
    config = DataConfig(path="unused", cache=str(tmp_path), rendered_training=1, rendered_validation=0, rendered_test=0)
    load_trials(config, small)
    damaged = next(tmp_path.rglob("table-*.npz" if kind == "table" else "*.npy"))
    damaged.write_bytes(damaged.read_bytes()[: int(kept * damaged.stat().st_size)])
    with pytest.raises(ContractError, match=f"{damaged.name} of the cache is damaged; remove it"):
        load_trials(config, small)


def test_a_full_disk_keeps_no_part_of_a_picture(small, tmp_path):
    config = DataConfig(path="unused", cache=str(tmp_path), rendered_training=1, rendered_validation=0, rendered_test=0)
    load_trials(config.model_copy(update={"rendered_training": 0}), small)
    before = set(tmp_path.rglob("*.np*"))
    with files_of_at_most(20_000), pytest.raises(ContractError, match=r"npy cannot be written, is the disk full\?"):
        load_trials(config, small)
    assert set(tmp_path.rglob("*.np*")) == before


def test_pictures_without_a_grid_of_markers_are_refused(small, tmp_path, monkeypatch):
    """As of a new sensor whose profile promises more than its camera shows."""
    monkeypatch.setattr(small, "frames", lambda *where: 0 * SyntheticSource.frames(small, *where))
    with pytest.raises(ContractError, match=r"frame 0 of a stored decision: a grid of 0 x 0 .*, expected 20 x 21"):
        load_trials(DataConfig(path="unused", cache=str(tmp_path)), small, "markers")


def test_pictures_of_another_renderer_are_drawn_anew(config, small, monkeypatch):
    few = config.data.model_copy(update={"rendered_training": 1, "rendered_validation": 0, "rendered_test": 0})
    first = load_trials(few, small).drawn
    monkeypatch.setattr(small, "frames", lambda *where: SyntheticSource.frames(small, *where) // 2)
    assert load_trials(few, small).drawn.mean() < 0.6 * first.mean()


@pytest.mark.parametrize("reads", ["pictures", "markers"])
def test_what_is_only_drawn_of_a_gel_in_motion_tells_renderers_apart(small, monkeypatch, reads):
    before = reader_sha256(small, reads)
    trial = small.trials[0]
    moving = trial.gel.copy()
    moving[trial.onset_frame :] *= 1.3
    monkeypatch.setattr(trial, "gel", moving)
    assert reader_sha256(small, reads) != before


def test_an_interrupted_drawing_goes_on_where_it_stopped(trials, drawing, small, monkeypatch):
    calls = []
    other = drawing.model_copy(update={"cache": drawing.cache + "-2"})

    def dies(index, start, count):
        calls.append(index)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return SyntheticSource.frames(small, index, start, count)

    monkeypatch.setattr(small, "frames", dies)
    with pytest.raises(KeyboardInterrupt):
        load_trials(other, small)
    monkeypatch.undo()
    assert np.array_equal(load_trials(other, small).drawn, trials.drawn)


def test_pictures_belong_to_their_trials(trials, small):
    index = int(trials.of("validation", rendered=True)[0])
    trial = next(i for i, t in enumerate(small.trials) if np.allclose((t.x_mm, t.theta_deg), trials.error[index]))
    start = small.trials[trial].onset_frame - 1
    assert np.array_equal(trials.drawn[trials.picture[index]], pool_frames(small.frames(trial, start, WINDOW), SENSOR))


def test_no_group_is_shared_between_splits(trials):
    groups = [set(trials.groups[trials.of(split)].tolist()) for split in ("train", "validation", "test")]
    assert len(groups[0] | groups[1] | groups[2]) == sum(len(group) for group in groups)


def test_a_group_in_two_splits_is_refused(tmp_path):
    source = SyntheticSource(10)
    source.trials[1] = replace(source.trials[1], split="test")
    with pytest.raises(ContractError, match="re-fixture group rectangle/0"):
        load_trials(DataConfig(path="unused", cache=str(tmp_path)), source)


def test_nan_labels_are_named_and_refused(tmp_path):
    source = SyntheticSource(10)
    source.trials[7] = replace(source.trials[7], theta_deg=float("nan"))
    with pytest.raises(ContractError, match="trial 7: error is not finite"):
        load_trials(DataConfig(path="unused", cache=str(tmp_path)), source)


def test_networks_of_frames_do_not_train_on_steps_of_depth(tmp_path):
    """Their figures would look right, and a camera would show them another motion."""
    made_up_dataset(tmp_path / "presses", [made_up_trial(k, drawn="{}", speed_mm_s=10.0) for k in range(3)])
    with pytest.raises(ContractError, match="trial 0: the frames of a drawn cell are equal steps of depth"):
        load_trials(DataConfig(path=str(tmp_path / "presses"), cache=str(tmp_path)), reads="markers")


def test_a_decision_starts_at_the_onset_and_is_relative_to_it(trials):
    batch = decisions(trials, trials.of("train")[:4], None, pictures=True)
    assert batch.fields.shape == (4, FRAMES_PER_DECISION, 2, 3, 20, 21)
    assert not batch.fields[:, 0].any()
    window = trials.drawn[trials.picture[trials.of("train")[0]]]
    if trials.picture[trials.of("train")[0]] >= 0:
        assert np.array_equal(batch.drawn[0].numpy(), window[1 : 1 + FRAMES_PER_DECISION])


def test_augmented_labels_follow_the_error(trials):
    batch = decisions(trials, trials.of("train"), np.random.default_rng(1), pictures=False)
    assert np.array_equal(batch.label.numpy(), class_of(batch.error.numpy()))
    assert np.allclose(np.abs(batch.error.numpy()), np.abs(trials.error[trials.of("train")]))


def test_mirroring_twice_changes_nothing():
    fields = np.random.default_rng(0).normal(size=(2, 20, 21, 3)).astype(np.float32)
    assert np.array_equal(mirror_fields(mirror_fields(fields)), fields)
