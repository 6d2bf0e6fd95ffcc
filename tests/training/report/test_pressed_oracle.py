"""The limit of pressing is read at steps of depth from the onset, and an oracle learns what the motion tells."""

import numpy as np

from tests.training.data.test_pressed import down
from training.networks.pressing import DECISION_STEPS, STEP_MM
from training.report import pressed_oracle
from training.report.pressed_oracle import oracle_rows, read_motions


def moved(count):
    """Presses whose object slides with x and turns with yaw, in proportion to the depth since the onset."""
    source = down(count)
    for trial in source.trials:
        since_mm = np.maximum(0.0, np.arange(30) - 7) * STEP_MM
        trial.in_hand = np.zeros((30, 6))
        trial.in_hand[:, 0] = 0.1 * since_mm * trial.x_mm
        trial.in_hand[:, 5] = 0.01 * since_mm * trial.theta_deg
        trial.stop_frame = 19
    return source


def test_motion_is_taken_at_the_steps_of_a_decision():
    source = moved(4)
    motions = read_motions(source)
    assert motions.motion.shape == (4, DECISION_STEPS, 6)
    slide = motions.motion[:, -1, 0] / motions.motion[:, 0, 0]
    np.testing.assert_allclose(slide, DECISION_STEPS, rtol=1e-5)


def test_the_oracle_learns_what_the_motion_tells(tmp_path, monkeypatch):
    monkeypatch.setattr(pressed_oracle, "STAGE", pressed_oracle.STAGE.model_copy(update={"epochs": 8}))
    source = moved(300)
    rows = oracle_rows(source, tmp_path)
    assert set(rows) >= {"validation/all", "test/all"}
    assert rows["test/all"]["mae_x_mm"] < 0.5 * np.mean([abs(trial.x_mm) for trial in source.trials])
