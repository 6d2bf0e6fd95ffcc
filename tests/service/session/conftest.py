from collections.abc import Iterator
from pathlib import Path

import pytest

from service.decision.models import ModelSet
from service.session.station import Station
from service.settings import Settings
from tests.service.session.driving import Cell, wait_for_recorders


@pytest.fixture
def idle(tmp_path: Path, models: ModelSet) -> Iterator[Station]:
    """A station whose threads were never started: the test is its perception thread."""
    settings = Settings(models=tmp_path, camera_left="push:", camera_right="push:", recordings=tmp_path)
    station = Station(settings, models, None)
    yield station
    station._networks.shutdown()


@pytest.fixture
def cell(tmp_path: Path, models: ModelSet) -> Iterator[Cell]:
    made = Cell(tmp_path, models)
    yield made
    made.manager.abort("operator", "test over")
    wait_for_recorders()
