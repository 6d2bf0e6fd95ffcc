"""Prometheus' own tool accepts our configuration, our alerts say what their tests expect, and our metrics are clean."""

import shutil
import subprocess
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import LiveService

FOLDER = Path(__file__).parents[3] / "docker" / "prometheus"
PROMTOOL = shutil.which("promtool")
pytestmark = pytest.mark.skipif(PROMTOOL is None, reason="no promtool on this machine (apt-get install prometheus)")


def promtool(*words: str, stdin: str = "") -> str:
    """Its output for an accepted input."""
    done = subprocess.run([str(PROMTOOL), *words], input=stdin, capture_output=True, text=True, cwd=FOLDER, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_it_accepts_the_configuration_and_its_rules() -> None:
    assert "SUCCESS" in promtool("check", "config", "prometheus.yml")


@pytest.mark.slow
def test_the_alerts_fire_when_their_tests_say_so() -> None:
    assert "SUCCESS" in promtool("test", "rules", "alerts_test.yml")


def test_it_finds_nothing_wrong_with_the_metrics_of_a_running_service(live: LiveService) -> None:
    metrics = httpx.get(live.url("/metrics")).text
    assert "tactile_" in metrics
    assert promtool("check", "metrics", stdin=metrics) == ""
