"""The perception thread's order of work: what everybody says must not keep it from the clock."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.decision.models import load_models
from service.session.station import TICK_S, Station
from service.settings import Settings


@pytest.fixture
def idle(tmp_path: Path, models_folder: Path) -> Iterator[Station]:
    """A station whose threads were never started: the test is its perception thread."""
    settings = Settings(models=models_folder, camera_left="push:", camera_right="push:", recordings=tmp_path)
    station = Station(settings, load_models(models_folder), None)
    yield station
    station._networks.shutdown()


def test_a_client_that_talks_all_the_time_does_not_keep_deadlines_from_being_looked_at(
    idle: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s, ticked_s = 100.0, []
    monkeypatch.setattr("service.session.station.now_ns", lambda: int(now_s * 1e9))
    monkeypatch.setattr(idle, "_tick", lambda: ticked_s.append(now_s))

    def heartbeat() -> None:
        nonlocal now_s
        now_s += 0.4 * TICK_S

    for _ in range(50):
        idle.post(heartbeat)
    idle._inbox.put(None)
    idle._run()
    assert len(ticked_s) >= 15
    assert max(b - a for a, b in itertools.pairwise(ticked_s)) <= 2 * TICK_S
