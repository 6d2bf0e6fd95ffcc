"""The same presses are read at several camera rates, and slow and quick ones apart."""

import numpy as np
import torch

from tests.training.conftest import PRESSING
from tests.training.data.test_pressed import down
from training.data.pressed import load_pressed
from training.fit.train import Trainer
from training.metrics.figures import Scales
from training.networks import build
from training.report.cameras import RATES_FPS, SPEEDS_MM_S, by_camera


def rows_of(source, config, tmp_path):
    trials = load_pressed(config.data.model_copy(update={"cache": str(tmp_path)}), source)
    trainer = Trainer(config, trials, build(PRESSING, 9, trials.sensor), torch.zeros(2, 3))
    return {row["read"]: row for row in by_camera(trainer, Scales(), source)}


def test_presses_too_quick_for_the_lowest_rate_count_at_no_rate(config, tmp_path):
    source = down(60)
    held = [trial for trial in source.trials if trial.split == "test"]
    for trial, speed_mm_s in zip(held, np.linspace(4.0, 30.0, len(held)), strict=True):
        trial.speed_mm_s = speed_mm_s
    rows = rows_of(source, config, tmp_path)
    rates = [rows[f"{fps:.0f} frames/s"] for fps in RATES_FPS]
    assert {row["trials"] for row in rates} == {sum(trial.speed_mm_s < 24.0 for trial in held)}
    assert rates[0]["gained"] == [0.0, 0.0, 0.0]
    for name, (low, high) in SPEEDS_MM_S.items():
        assert rows[name]["trials"] == sum(low <= trial.speed_mm_s < high for trial in held)


def test_a_speed_that_no_press_has_gets_no_row(config, tmp_path):
    assert SPEEDS_MM_S.keys() & rows_of(down(60), config, tmp_path).keys() == {"7 to 14 mm/s"}


def test_a_dataset_without_test_presses_or_with_quick_ones_alone_gets_no_row_of_a_rate(config, tmp_path):
    source = down(60)
    for trial in source.trials:
        trial.speed_mm_s = 30.0
    assert rows_of(source, config, tmp_path / "quick").keys() == {"18 to 35 mm/s"}
    for trial in source.trials:
        trial.split = "train" if trial.split == "test" else trial.split
    assert rows_of(source, config, tmp_path / "none") == {}
