"""The other ways to deploy, tried for `make verify-images`: live profile, monitoring, Kubernetes' pod, offline bundle.

Cameras are the simulated cell's MJPEG streams, which a service cannot tell from an IP camera's.
"""

import json
import os
import re
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.docker.images import ROOT, VerificationError, base_image, buildah, call
from tests.docker.sim_loop import Loop, free_port, waited

LOCAL_PROMETHEUS = "localhost/prometheus:debian"
PINNED = "0"
PROMETHEUS_DOCKERFILE = """FROM {base}
COPY prometheus /bin/prometheus
WORKDIR /prometheus
ENTRYPOINT ["/bin/prometheus"]
"""
POD = "verify-images-pod"
Add = Callable[[str, str, bool], None]


def calibration(loop: Loop) -> str:
    """The calibration file that the running simulated cell wrote."""
    return call(["podman", "exec", loop.container("cell"), "cat", "/var/lib/tactile/cell/calibration.toml"]) + "\n"


def cameras(loop: Loop) -> dict[str, str]:
    """Where the simulated cell's two streams are, by compose's variable."""
    return {
        f"CAMERA_{side}": f"http://127.0.0.1:{loop.ports[f'CAMERA_{side}_PORT']}/stream.mjpg"
        for side in ("LEFT", "RIGHT")
    }


def live_cameras(loop: Loop) -> int:
    """How many cameras a service on the loop's port calls live; 0 while it does not answer."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{loop.ports['SERVICE_PORT']}/v1/cameras", timeout=3) as reply:
            return sum(camera["state"] == "live" for camera in json.load(reply)["cameras"])
    except OSError:
        return 0


def check_live(add: Add, loop: Loop) -> None:
    """The `live` profile reads its cameras by URL and its calibration from the mounted folder, and becomes ready."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)  # the container's user reads it
        (Path(folder) / "calibration.toml").write_text(calibration(loop))
        os.environ.update(cameras(loop), CONFIG_DIR=folder, SERVICE_CPUSET=PINNED)
        live = [*loop.compose, "--profile", "live"]
        try:
            call([*live, "up", "--detach", "--no-build", "service"])
            seconds = loop.wait_healthy("service", 120)
            count = live_cameras(loop)
            add("live profile, cameras by URL: ready", f"after {seconds:.0f} s, {count} cameras live", count == 2)
            status = Path(f"/proc/{loop.process('service')}/status").read_text()
            cores = status.split("Cpus_allowed_list:")[1].split()[0]
            add(f"live profile, SERVICE_CPUSET={PINNED}: runs on", f"processor {cores}", cores == PINNED)
        finally:
            os.environ["SERVICE_CPUSET"] = ""
            call([*loop.compose, "stop", "service"], check=False)
            call(["podman", "rm", "--force", loop.container("service")], check=False)


def check_monitoring(add: Add, loop: Loop) -> None:
    """The `monitoring` profile's Prometheus scrapes the running service, loads every alert rule, and sees it die.

    Without a registry of images Prometheus is Debian's, put on the base image; Grafana is in no Debian release, so its
    container is started only where its image can be pulled.
    """
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        for path in (ROOT / "docker" / "prometheus").glob("*.yml"):
            (Path(folder) / path.name).write_text(path.read_text().replace("8000", loop.ports["SERVICE_PORT"]))
        os.environ.update(PROMETHEUS_DIR=folder, PROMETHEUS_PORT=free_port(), PROMETHEUS_IMAGE=prometheus_image())
        monitoring = [*loop.compose, "--profile", "monitoring"]
        try:
            call([*monitoring, "up", "--detach", "--no-build", "prometheus"])
            seconds = waited(lambda: scraped() == "1", 120, "the service scraped", lambda: loop.logs("prometheus"))
            rules = prometheus("rules")["groups"][0]["rules"]
            add("monitoring profile: service scraped", f"after {seconds:.0f} s, {len(rules)} alert rules", bool(rules))
            call(["podman", "stop", "--time", "30", loop.container("service-sim")])
            seconds = waited(lambda: pending("ServiceDown"), 90, "ServiceDown raised")
            add("monitoring profile: service stopped, ServiceDown raised", f"after {seconds:.0f} s", True)
        finally:
            call([*monitoring, "stop", "prometheus"], check=False)
            call(["podman", "rm", "--force", loop.container("prometheus")], check=False)
            call([*loop.compose, "--profile", "sim", "up", "--detach", "--no-build", "service-sim"], check=False)


def prometheus_image() -> str:
    """The image that compose names if it can be had, otherwise one with this machine's own `prometheus` on the base."""
    compose = (ROOT / "docker" / "compose.yaml").read_text()
    named = re.findall(r"PROMETHEUS_IMAGE:-([^}]+)\}", compose)[0]
    pull = subprocess.run(["timeout", "60", "podman", "pull", "-q", named], capture_output=True, check=False)
    if pull.returncode == 0:
        return str(named)
    binary = shutil.which("prometheus")
    if binary is None:
        raise VerificationError(f"{named} cannot be pulled and there is no prometheus here: apt-get install prometheus")
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(binary, folder)
        (Path(folder) / "Dockerfile").write_text(PROMETHEUS_DOCKERFILE.format(base=base_image()))
        buildah(LOCAL_PROMETHEUS, Path(folder) / "Dockerfile", Path(folder))
    return LOCAL_PROMETHEUS


def prometheus(path: str) -> Any:
    """The data of one answer of the started Prometheus."""
    with urllib.request.urlopen(f"http://127.0.0.1:{os.environ['PROMETHEUS_PORT']}/api/v1/{path}", timeout=3) as reply:
        return json.load(reply)["data"]


def scraped() -> str:
    """The value of `up` for the cell, empty while there is none."""
    try:
        series = prometheus("query?query=up")["result"]
    except OSError:
        return ""
    return str(series[0]["value"][1]) if series else ""


def pending(alert: str) -> bool:
    """Whether an alert is pending or firing."""
    return any(entry["labels"]["alertname"] == alert for entry in prometheus("alerts")["alerts"])


def check_pod(add: Add, loop: Loop) -> None:
    """`podman kube play` runs the Kubernetes manifest, with this run's ports and calibration, until it is ready."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(pod_manifest(loop))
        try:
            started = time.monotonic()
            call(["podman", "kube", "play", str(path)], timeout_s=120)
            waited(lambda: live_cameras(loop) == 2, 120, "both cameras live in the pod")
            add("Kubernetes manifest under podman: ready", f"after {time.monotonic() - started:.0f} s", True)
        finally:
            call(["podman", "kube", "down", str(path)], check=False)
            call(["podman", "volume", "rm", "--force", f"{POD}-recordings", f"{POD}-calibration"], check=False)


def pod_manifest(loop: Loop) -> str:
    """The shipped manifest; its volumes get other names, so that no real recordings are touched."""
    manifest = (ROOT / "docker" / "kubernetes" / "cell.yaml").read_text()
    for written, port in (("8000", "SERVICE_PORT"), ("8182", "CAMERA_LEFT_PORT"), ("8183", "CAMERA_RIGHT_PORT")):
        manifest = manifest.replace(written, loop.ports[port])
    # On the host's network a containerPort only tells the scheduler what is taken; podman 4 refuses it.
    manifest = re.sub(r"^ +ports: .*\n", "", manifest, flags=re.MULTILINE)
    manifest = re.sub(r"([nN]ame: )(recordings|calibration)\b", rf"\1{POD}-\2", manifest)
    lines = "".join(f"    {line}\n" for line in calibration(loop).splitlines())
    given = f"kind: ConfigMap\nmetadata: {{name: {POD}-calibration}}\ndata:\n  calibration.toml: |\n{lines}"
    return f"apiVersion: v1\n{given}---\n{manifest}"


def check_bundle(add: Add, archive: Path) -> None:
    """The bundle installs in the bare base with no network at all, and the client there rehearses an insertion."""
    script = (
        "cd /tmp && tar xf /bundle.tar && cd tactile-insertion-* && ./install.sh --no-systemd >/dev/null"
        " && cd /opt/tactile-insertion/app && ../venv/bin/python -m service models models >/dev/null"
        " && ../venv/bin/python -m robot_client insert --x-mm 8 --theta-deg 6 --log /tmp/episode.jsonl"
    )
    command = [
        *("podman", "run", "--rm", "--network", "none", "-v", f"{archive}:/bundle.tar:ro"),
        *("--entrypoint", "sh", base_image(), "-c", script),
    ]
    started = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    last = (done.stdout + done.stderr).strip().splitlines()[-1:]
    add(
        "bundle without network: installed, models checked, rehearsal",
        f"exit {done.returncode} after {time.monotonic() - started:.0f} s, {archive.stat().st_size / 1e6:.0f} MB"
        + ("" if done.returncode == 0 else f": {last}"),
        done.returncode == 0,
    )
