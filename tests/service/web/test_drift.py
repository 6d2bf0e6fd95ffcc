"""Drift is measured on each insertion, and reported to the person, the log and Prometheus."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.decision.models import load_models
from service.observability.charts import LEARNT_N, LIMIT
from service.session.manager import CHARTS
from tests.service.client import greeted
from tests.service.conftest import LiveService, live_service
from tests.service.session.driving import manager
from tests.waiting import wait_for


@pytest.fixture
def cell(tmp_path: Path, models_folder: Path) -> Iterator[LiveService]:
    with live_service(tmp_path, models_folder) as service:
        yield service


def insert(cell: LiveService, name: str) -> dict[str, object]:
    """An object that is inserted at once; returns its summary."""
    driver = greeted(cell, name)
    finished = driver.insert(1)
    driver.close()
    return json.loads((Path(finished.recording).parent / "summary.json").read_text())


def kept(cell: LiveService, n: int) -> dict[str, Any]:
    """Contents of the charts' file once ``n`` insertions were added."""

    def charts() -> dict[str, Any] | None:
        path = cell.recordings / CHARTS
        made = json.loads(path.read_text())["charts"] if path.exists() else None
        return made if made and sum(map(len, made["light"]["learnt"].values())) == n else None

    return wait_for(charts)


def test_a_changed_light_is_measured_and_named_everywhere(cell: LiveService) -> None:
    summary = insert(cell, "first")
    assert 0 < summary["brightness_grey"] < 255
    assert 0.5 < summary["markers_share"] <= 1.0
    charts = kept(cell, 1)
    assert charts["light"]["learnt"] == {"": [summary["brightness_grey"]]}
    assert charts["trials"]["learnt"] == {"": [1.0]}
    light = cell.station.manager.charts._charts["light"]
    light.learnt[""] = sorted(summary["brightness_grey"] + 10.0 + 0.1 * i for i in range(LEARNT_N))
    light.low = LIMIT - 1.0
    insert(cell, "darker")
    (alarm,) = wait_for(lambda: httpx.get(cell.url("/v1/status")).json()["alarms"])
    assert (alarm["key"], alarm["level"], alarm["active"]) == ("drift light", "warning", True)
    assert "changed light" in alarm["title"]
    assert "brightness" in alarm["detail"]
    assert alarm["remedy"]
    metrics = cell.metrics()
    assert 'tactile_drift_alarms_total{cause="changed light"} 1.0' in metrics
    assert 'tactile_drift{chart="trials"} 0.0' in metrics


def test_charts_that_cannot_be_kept_alarm_all_the_same(models_folder: Path, tmp_path: Path) -> None:
    models = load_models(models_folder)
    tried, heard = manager(models, tmp_path), []
    tried.hub.subscribe(lambda kind, content: heard.append((kind, content)))
    summary = {"insertion_id": "one", "outcome": "inserted", "attempts": 1, "brightness_grey": 80.0}
    tried._chart(summary, models)
    light = tried.charts._charts["light"]
    light.learnt[""] = [90.0 + 0.1 * i for i in range(LEARNT_N)]
    light.low = LIMIT - 1.0
    tried._chart(summary, models)
    assert not tried.settings.recordings.exists()
    assert [kind for kind, _ in heard] == ["error", "drift", "error"]
    assert heard[1][1]["cause"] == "changed light"
