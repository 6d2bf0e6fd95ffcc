"""The operations files agree with each other and with the code, as far as that shows without building an image."""

import http.server
import json
import re
import subprocess
import sys
import threading
from typing import get_args

import pytest
import yaml

from service.contract import wire_parts
from service.contract.replies import MEANT
from service.contract.shipped import released_models
from service.session.station import open_station
from service.settings import Settings
from service.web.metrics import Metrics
from tests.docker.images import pinned_base
from tests.docker.verify_images import MODELS
from tests.docs.commands import ROOT

DOCKER = ROOT / "docker"
UNIT = DOCKER / "systemd" / "tactile-insertion@.service"
DOCKERFILES = sorted(DOCKER.glob("*.Dockerfile"))
MAY_COPY = {
    "service": {"service"},
    "robot_client": {"robot_client", "service/__init__.py", "service/contract"},
    "simulation": {
        *("simulation", "service/__init__.py", "service/contract", "service/perception", "service/sensors"),
        *("robot_client/__init__.py", "robot_client/insertion", "robot_client/robots", "robot_client/grippers"),
    },
}


def test_all_images_stand_on_one_base_pinned_by_digest():
    assert re.search(r"@sha256:[0-9a-f]{64}$", pinned_base())


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_runs_as_nobody_special_with_exec_form_commands(path):
    text = path.read_text()
    assert re.search(r"^USER 10001:10001$", text, re.MULTILINE)
    assert re.search(r"^ENTRYPOINT \[", text, re.MULTILINE)
    assert re.search(r"^CMD \[", text, re.MULTILINE)
    assert "--require-hashes" in text


@pytest.mark.parametrize("path", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_carries_its_own_room_and_nothing_of_a_sibling(path):
    copied = set(
        re.findall(r"^COPY ((?:service|robot_client|simulation|training|export)\S*) ", path.read_text(), re.MULTILINE)
    )
    assert copied == MAY_COPY[path.stem]


def test_the_image_has_the_released_networks_and_is_compared_with_them():
    (copied,) = re.findall(r"^COPY (\S+) /models$", (DOCKER / "service.Dockerfile").read_text(), re.MULTILINE)
    assert ROOT / copied == released_models().resolve() == MODELS


@pytest.mark.parametrize("role", ["service", "robot", "simulation", "run"])
def test_no_shipped_role_pins_torch(role):
    assert not re.search(r"^(torch|nvidia-\S+)==", (ROOT / "requirements" / f"{role}.txt").read_text(), re.MULTILINE)


@pytest.mark.parametrize("path", sorted(DOCKER.glob("*.sh")), ids=lambda path: path.name)
def test_a_shell_script_parses(path):
    assert subprocess.run(["sh", "-n", str(path)], check=False).returncode == 0


@pytest.mark.parametrize("override", [False, True])
def test_make_reads_the_override_that_lets_usb_cameras_in(tmp_path, override):
    """Compose looks for an override by itself only where no file is named, and make names one."""
    for name in ("Makefile", "requirements/ops.txt", "docker/compose.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    if override:
        (tmp_path / "docker" / "compose.override.yaml").write_text("services: {}")
    printed = subprocess.run(
        ["make", "-n", "image", "COMPOSE=compose"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ("--file docker/compose.yaml --file docker/compose.override.yaml" in printed.stdout) is override


def test_a_bundle_holds_the_page_that_its_unit_points_to():
    pointed = re.search(r"^Documentation=file:///opt/tactile-insertion/app/(\S+)$", UNIT.read_text(), re.MULTILINE)[1]
    archived = (DOCKER / "bundle.sh").read_text().replace("\\\n", " ")
    (given,) = re.findall(r"^git archive HEAD (.*?) \| tar", archived, re.MULTILINE)
    assert {pointed, "docs"} <= set(given.split())
    assert {"docker/prometheus", "docker/grafana"} <= set(given.split())  # which docs/deployment.md names


def test_a_camera_that_is_plugged_in_after_the_start_may_be_opened():
    """Its group of devices is allowed by name, which the kernel has only once the module is loaded."""
    unit = UNIT.read_text()
    assert "DeviceAllow=char-video4linux rw" in unit
    for order in ("After", "Wants"):
        assert "modprobe@videodev.service" in re.search(rf"^{order}=(.*)$", unit, re.MULTILINE)[1].split()


def test_systemd_starts_a_service_again_however_it_ended_and_however_often():
    """What refuses a start may pass: an address that is not there yet at boot, a lock that a dying process holds."""
    unit = UNIT.read_text()
    assert {"Restart=always", "RestartSec=5", "StartLimitIntervalSec=0"} <= set(unit.splitlines())
    assert "RestartPreventExitStatus" not in unit


def test_what_watches_starts_with_the_machine_and_what_moves_does_not():
    """At boot podman starts those that restart always, and no others; docker would start those unless stopped, too."""
    started = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    moves = {"robot-client", "robot-client-sim", "cell"}
    assert {name: one["restart"] for name, one in started.items()} == {
        name: "no" if name in moves else "always" for name in started
    }


def test_kubernetes_restarts_a_service_for_its_own_sake_only():
    """What is killed while it is not ready would end again and again for a camera that is unplugged at its start."""
    documents = yaml.safe_load_all((DOCKER / "kubernetes" / "cell.yaml").read_text())
    (service,) = next(one for one in documents if one["kind"] == "Deployment")["spec"]["template"]["spec"]["containers"]
    asks = {probe: service[f"{probe}Probe"]["exec"]["command"][-1] for probe in ("startup", "liveness", "readiness")}
    assert asks == {"startup": "/healthz", "liveness": "/healthz", "readiness": "/readyz"}


def test_kubernetes_promises_no_metrics_where_nobody_listens():
    """Prometheus would ask the pod's address, which is the machine's, and the service listens on loopback."""
    configuration, *_, deployed = yaml.safe_load_all((DOCKER / "kubernetes" / "cell.yaml").read_text())
    assert "TACTILE_HOST" not in configuration["data"]
    assert "annotations" not in deployed["spec"]["template"]["metadata"]


def test_no_log_fills_the_disk_that_the_recordings_need():
    started = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    assert [name for name, one in started.items() if "max-size" not in one.get("logging", {}).get("options", {})] == []


class _Answer(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200 if self.path == "/readyz" else 503)
        self.end_headers()

    def log_message(self, *args):
        pass


@pytest.fixture
def port():
    server = http.server.HTTPServer(("127.0.0.1", 0), _Answer)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield server.server_port
    server.shutdown()
    thread.join()
    server.server_close()


def healthcheck(port: int, path: str) -> int:
    return subprocess.run(
        [sys.executable, "-I", "-S", DOCKER / "healthcheck.py", str(port), path], check=False
    ).returncode


def test_the_healthcheck_passes_on_200_only(port):
    assert healthcheck(port, "/readyz") == 0
    assert healthcheck(port, "/other") == 1


def test_the_healthcheck_fails_where_nobody_listens(port):
    assert healthcheck(1, "/readyz") == 1


def metrics_read(text: str) -> set[str]:
    """Names of our metrics that a query file reads, without the suffixes that Prometheus adds."""
    return {re.sub(r"_(total|bucket|count|sum)$", "", name) for name in re.findall(r"\btactile_[a-z_]+", text)}


@pytest.fixture
def metrics(tmp_path):
    """The metrics of a service that has just started."""
    cameras = dict.fromkeys(("camera_left", "camera_right"), "push:")
    station = open_station(Settings(models=ROOT / "models", recordings=tmp_path, state=tmp_path, **cameras))
    station.owned.close()
    return Metrics(station)


@pytest.mark.parametrize("path", ["prometheus/alerts.yml", "prometheus/alerts_test.yml", "grafana/dashboard.json"])
def test_alerts_and_dashboard_read_only_metrics_that_the_service_has(path, metrics):
    assert metrics_read((DOCKER / path).read_text()) <= {family.name for family in metrics.registry.collect()}


def test_what_an_alert_counts_has_its_series_from_the_start(metrics):
    """A gel that is worn out gives no correction: a sum with no series of these is none, and so is the alert."""
    counted = set(re.findall(r"increase\((tactile_\w+)", (DOCKER / "prometheus" / "alerts.yml").read_text()))
    series = [sample for family in metrics.registry.collect() for sample in family.samples]
    assert counted <= {sample.name for sample in series}
    labels = {(sample.name, *sample.labels.values()) for sample in series}
    assert ("tactile_messages_total", "correction") in labels
    assert labels >= {("tactile_no_decisions_total", reason) for reason in get_args(wire_parts.NoDecisionReason)}
    assert sum(name == "tactile_camera_faults_total" for name, *_ in labels) == 2 * 4, "of each finger, each kind"


def test_a_camera_is_slow_by_the_rate_that_it_is_asked_for(metrics):
    """Sensors have 10 to 120 frames a second: by one figure for all, some would be slow for ever and others never."""
    for finger in ("left", "right"):
        assert metrics.registry.get_sample_value("tactile_frames_expected_hz", {"finger": finger}) == 30.0


@pytest.mark.parametrize("path", ["prometheus/alerts.yml", "grafana/dashboard.json"])
def test_what_ended_as_it_was_meant_to_counts_neither_as_inserted_nor_as_failed(path):
    """A panel may show how often a person stops the cell, beside the failures."""
    text = (DOCKER / path).read_text().replace('\\"', '"')
    named = [set(words.split("|")) for words in re.findall(r'\boutcome=~?"([^"]+)"', text)]
    assert "outcome!" not in text, "what is left out of a list would count"
    assert {"inserted", "failed"} <= set().union(*named) <= set(get_args(wire_parts.Ending))
    tried = [words for words in named if words & set(MEANT.values())]
    assert tried == ([{"not_confirmed", "failed", "aborted"}] if "grafana" in path else [])


def test_a_figure_of_now_is_none_of_a_service_that_has_gone():
    """Over a range, the last value would be shown for hours: `ready` of a service that is no more."""
    panels = json.loads((DOCKER / "grafana" / "dashboard.json").read_text())["panels"]
    now = [target for panel in panels if panel["type"] == "stat" for target in panel["targets"]]
    assert now
    assert all(target["instant"] and not target["range"] for target in now)


def test_every_alert_is_tested():
    alerts = set(re.findall(r"- alert: (\w+)", (DOCKER / "prometheus" / "alerts.yml").read_text()))
    tests = (DOCKER / "prometheus" / "alerts_test.yml").read_text()
    assert alerts
    assert {name for name in alerts if name not in tests} == set()


def test_prometheus_tells_the_alertmanager_that_compose_starts_about_every_severity():
    targets = yaml.safe_load((DOCKER / "prometheus" / "prometheus.yml").read_text())["alerting"]["alertmanagers"]
    started = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]["alertmanager"]
    assert started["profiles"] == ["monitoring"]
    (address,) = targets[0]["static_configs"][0]["targets"]
    assert f"--web.listen-address={address}" in started["command"]
    routed = yaml.safe_load((DOCKER / "prometheus" / "alertmanager.yml").read_text())
    assert [(one["matchers"], one["receiver"]) for one in routed["route"]["routes"]] == [(['severity="page"'], "pages")]
    assert {one["name"] for one in routed["receivers"]} == {routed["route"]["receiver"], "pages"}
    severities = re.findall(r"severity: (\w+)", (DOCKER / "prometheus" / "alerts.yml").read_text())
    assert set(severities) == {"page", "ticket"}
