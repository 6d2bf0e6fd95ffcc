from pathlib import Path

import numpy as np
import pytest

from service import rehearsal
from service.contract import ContractError, TactileFrame
from service.models import load_models
from service.rehearsal import rehearse
from service.sessions import make_session
from tests.service import drawn


def test_a_rehearsal_runs_through_perception_networks_and_every_controller(
    models_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moved: list[str] = []
    make = rehearsal.make_controller
    monkeypatch.setattr(rehearsal, "make_controller", lambda name, limits: moved.append(name) or make(name, limits))
    session = make_session(load_models(models_folder), drawn.calibration())
    pair = drawn.pair(0)
    rehearse(session, [pair.left, pair.right])
    assert moved == ["heuristic", "belief"]
    assert (session.insertion_id, session.attempt) == (None, None)
    rehearse(session, [])  # a service whose cameras come later


def test_a_frame_of_the_wrong_size_is_named(models_folder: Path) -> None:
    session = make_session(load_models(models_folder), drawn.calibration())
    with pytest.raises(ContractError, match="frame is uint8"):
        rehearse(session, [TactileFrame("left", 0, 0, np.zeros((480, 640, 3), np.uint8))])
