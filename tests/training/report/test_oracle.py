"""What the true motion in the hand says is the yardstick; a network where it was not trained is scored in the open."""

import json

import numpy as np
import pytest

from simulation.cli.dataset import collect
from training.config import DataConfig
from training.data.dataset import load_trials
from training.fit.train import train
from training.report.oracle import oracle_figures
from training.report.stress import STRESS_FILE, stress


def test_the_oracle_learns_what_the_motion_in_the_hand_tells(config, source, tmp_path):
    trials = load_trials(config.data, source)
    rng = np.random.default_rng(0)
    shown = np.linspace(0, 1, trials.motion.shape[1])[:, None] * trials.error[:, None]  # slide with x, turn with yaw
    trials.motion[..., [0, 5]] = shown + rng.normal(0, 1e-3, shown.shape)
    rows = oracle_figures(trials, tmp_path / "oracle")
    assert rows["validation/all"]["mae_x_mm"] < 5.0 < np.abs(trials.error[:, 0]).mean()
    assert {name.split("/")[0] for name in rows} == {"validation", "test"}


@pytest.mark.slow
def test_a_run_is_scored_under_noise_on_new_objects_and_keeps_it(config, tmp_path):
    for name, scene in (("old", "circle"), ("new", "can")):
        asked = ["--objects", scene, "--trials-per-object", "40", "--trials-per-shard", "40", "--workers", "1"]
        collect(["--out", str(tmp_path / name), *asked])
    data = DataConfig(path=str(tmp_path / "old"), cache=str(tmp_path / "cache"), rendered_training=8)
    run = config.model_copy(update={"data": data})
    train(run)
    rows = stress(run.folder, trials=4, new=tmp_path / "new")
    assert {"noise x 0.25/all", "noise x 4/all", "new objects/can"} <= rows.keys()
    assert json.loads((run.folder / STRESS_FILE).read_text()) == rows
