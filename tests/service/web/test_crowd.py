"""A benchmark under load measures under that load: the crowd floods what is served, and says if it could not."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.benchmarks.crowd import CrowdError, crowd
from tests.benchmarks.hostile import NO_CAMERAS, bodies
from tests.service.process import ServiceProcess, service_process

MODELS = Path(__file__).parents[3] / "models"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    recordings = tmp_path_factory.mktemp("crowd") / "recordings"
    with service_process(MODELS / "pressing", recordings, *NO_CAMERAS) as running:
        yield running


def test_the_networks_that_ship_are_flooded_while_pages_look_on(service: ServiceProcess) -> None:
    with crowd(service, ["/v1/live", "/v1/live"]) as load:
        assert "inferences_per_s" not in load, "known at the end"
        time.sleep(1.0)
    assert load["pages"] == 2
    assert min(load["inferences_per_s"], load["page_messages_per_s"]) > 0.0


def test_hostile_bodies_are_sent_to_a_network_that_is_served(service: ServiceProcess) -> None:
    assert "404" not in bodies(service)["answers"]


def test_a_viewer_that_is_not_let_in_fails_the_benchmark(service: ServiceProcess) -> None:
    with pytest.raises(CrowdError, match="died"), crowd(service, ["/v1/nowhere"], asks=False):
        pass


def test_a_flood_that_ends_in_mid_measurement_fails_the_benchmark(service: ServiceProcess) -> None:
    with pytest.raises(CrowdError, match="died"), crowd(service):
        service.kill()
