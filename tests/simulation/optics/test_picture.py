"""Pictures: drawn from plain arrays, with any part of the decision."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from service.contract import Sensor
from simulation.cli import probe
from simulation.optics import attempt_picture
from simulation.optics.attempt_picture import Decision

DECISION: attempt_picture.Decision = {
    "title": "attempt 2",
    "estimate": (2.5, -3.0),
    "correction": (-1.75, 2.1),
    "interval": ((1.0, 4.0), (-5.0, -1.0)),
    "direction": [[0.0, 0.0, 0.0], [0.1, 0.2, 0.7], [0.0, 0.0, 0.0]],
}
STEPS = np.full((2, 20, 21, 2), 2.0)
STEPS[0, 3, 3] = np.nan
MOVED = (np.broadcast_to(Sensor.load().marker_rest_px(), STEPS.shape), STEPS), np.ones((2, 20, 21), bool)


@pytest.mark.parametrize(
    ("count", "decision"), [(12, {"title": "one"}), (1, DECISION), (8, {"title": "two", "estimate": (1.0, 2.0)})]
)
def test_a_picture_is_drawn_from_what_is_there(tmp_path: Path, decision: Decision, count: int) -> None:
    frames = np.full((count, 2, 320, 327, 3), 90, np.uint8)
    path = attempt_picture.save(tmp_path / "new" / "attempt.png", frames, decision, *MOVED)
    assert cv2.imread(str(path)).shape == (840, 1500, 3)


def test_every_number_of_a_decision_is_written_with_its_unit() -> None:
    text = "\n".join(attempt_picture.fact_lines(DECISION))
    for part in ("+2.50 mm", "-1.75 mm", "+2.10 deg", "+1.0..+4.0 mm", "-5.0..-1.0 deg"):
        assert part in text
    assert len({len(line) for line in text.splitlines()}) == 1, "numbers stand below numbers"


def test_frames_of_another_shape_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected \\[n, 2, height, width, 3\\]"):
        attempt_picture.save(tmp_path / "a.png", np.zeros((8, 320, 327, 3), np.uint8), DECISION, *MOVED)


def test_the_plate_of_the_docs_can_be_made_again(tmp_path: Path) -> None:
    assert probe.imprint(["--out", str(tmp_path / "imprint.png"), "--objects", "circle"]) == 0
    assert cv2.imread(str(tmp_path / "imprint.png")) is not None
