from collections.abc import Iterator
from pathlib import Path

import pytest

from service.decision.models import ModelSet
from service.session.station import Station
from service.settings import Settings


@pytest.fixture
def idle(tmp_path: Path, models: ModelSet) -> Iterator[Station]:
    """A station whose threads were never started: the test is its perception thread."""
    settings = Settings(models=tmp_path, camera_left="push:", camera_right="push:", recordings=tmp_path)
    station = Station(settings, models, None)
    yield station
    station._networks.shutdown()
