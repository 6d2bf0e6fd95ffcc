"""Build the three images with podman's tools, with or without a registry of images in reach.

Without one the base is made from Debian packages (`mmdebstrap`) and named in the Dockerfiles' ARG BASE; the Dockerfiles
themselves are built unchanged. Standard library only.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, MutableMapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "tactile-insertion"
LOCAL_BASE = "localhost/python:3.11-slim-bookworm"
IMAGES = {
    "service": "localhost/tactile-insertion-service:dev",
    "robot_client": "localhost/tactile-insertion-robot-client:dev",
    "simulation": "localhost/tactile-insertion-simulation:dev",
}
NEEDED = ("podman", "buildah", "runc", "catatonit")
PACKAGES = "python3,python3-pip,python3-venv,ca-certificates"
CONTAINERS_CONF = """[containers]
default_ulimits = ["nofile=20000:20000", "nproc=1024:1024"]
[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
events_logger = "file"
"""
BASE_DOCKERFILE = """FROM scratch
ADD rootfs.tar /
RUN rm -f /usr/lib/python3*/EXTERNALLY-MANAGED && ln -s python3 /usr/bin/python
"""


class VerificationError(ValueError):
    """A requirement does not hold; the text says which."""


def say(text: str) -> None:
    """One line of progress, at once."""
    print(text, flush=True)


def call(arguments: Sequence[str], *, timeout_s: float = 900, check: bool = True) -> str:
    """Run a command and return its standard output; VerificationError with its last lines if it fails."""
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=timeout_s, check=False, cwd=ROOT)
    if check and done.returncode != 0:
        tail = " | ".join((done.stderr or done.stdout).strip().splitlines()[-6:])
        raise VerificationError(f"`{' '.join(arguments[:6])}` ended with {done.returncode}: {tail}")
    return str(done.stdout).strip()


def prepare_engine(environment: MutableMapping[str, str]) -> None:
    """Check the tools and give podman a configuration that needs neither systemd nor a bridge."""
    missing = [tool for tool in NEEDED if shutil.which(tool) is None]
    if missing:
        raise VerificationError(
            f"{', '.join(missing)} not found: apt-get install podman buildah runc catatonit mmdebstrap"
        )
    CACHE.mkdir(parents=True, exist_ok=True)
    if "CONTAINERS_CONF" not in environment:
        (CACHE / "containers.conf").write_text(CONTAINERS_CONF)
        environment["CONTAINERS_CONF"] = str(CACHE / "containers.conf")


def pinned_base() -> str:
    """The base that the Dockerfiles name; all three must name the same."""
    bases: set[str] = {
        image
        for name in IMAGES
        for image in re.findall(r"^ARG BASE=(\S+)$", (ROOT / "docker" / f"{name}.Dockerfile").read_text(), re.MULTILINE)
    }
    if len(bases) != 1 or "@sha256:" not in next(iter(bases)):
        raise VerificationError(f"the Dockerfiles' bases are {sorted(bases)}, expected one, pinned by digest")
    return bases.pop()


def base_image() -> str:
    """The pinned base if a registry answers, otherwise one made from Debian packages and kept for next time."""
    pinned = pinned_base()
    if subprocess.run(["podman", "image", "exists", LOCAL_BASE], check=False).returncode == 0:
        return LOCAL_BASE
    pull = subprocess.run(["timeout", "120", "podman", "pull", "-q", pinned], capture_output=True, check=False)
    if pull.returncode == 0:
        return pinned
    if shutil.which("mmdebstrap") is None:
        raise VerificationError(
            "no registry of images answers and mmdebstrap is not installed (apt-get install mmdebstrap)"
        )
    say(f"no registry answers for {pinned.split('@')[0]}: making the base from Debian packages")
    folder = CACHE / "base"
    folder.mkdir(parents=True, exist_ok=True)
    sources = [str(path) for path in (Path("/etc/apt/sources.list.d/debian.sources"),) if path.exists()]
    call(
        [
            "mmdebstrap",
            "-q",
            "--variant=minbase",
            f"--include={PACKAGES}",
            "bookworm",
            str(folder / "rootfs.tar"),
            *sources,
        ]
    )
    (folder / "Dockerfile").write_text(BASE_DOCKERFILE)
    buildah(LOCAL_BASE, folder / "Dockerfile", folder)
    return LOCAL_BASE


def buildah(tag: str, dockerfile: Path, context: Path, arguments: Mapping[str, str] | None = None) -> float:
    """Build one image without a daemon; seconds it took. This machine's trust in its package index goes along."""
    mounts = [path for path in ("/etc/ssl/certs/ca-certificates.crt", "/etc/pip.conf") if Path(path).is_file()]
    started = time.monotonic()
    call(
        [
            *("buildah", "bud", "--isolation", "chroot", "--network", "host", "--format", "docker", "--layers"),
            *(part for path in mounts for part in ("-v", f"{path}:{path}:ro")),
            *(part for key, value in (arguments or {}).items() for part in ("--build-arg", f"{key}={value}")),
            *("-t", tag, "-f", str(dockerfile), str(context)),
        ],
        timeout_s=1800,
    )
    return time.monotonic() - started


def size_mb(image: str) -> float:
    """Uncompressed size of an image in 10^6 bytes."""
    return float(json.loads(call(["podman", "image", "inspect", image]))[0]["Size"]) / 1e6


def build_all() -> dict[str, tuple[float, float]]:
    """Build every image; by name the MB beyond the base and the seconds it took."""
    base = base_image()
    base_mb = size_mb(base)
    say(f"base {base.split('@')[0]}: {base_mb:.0f} MB")
    built = {}
    for name, tag in IMAGES.items():
        seconds = buildah(tag, ROOT / "docker" / f"{name}.Dockerfile", ROOT, {"BASE": base})
        built[name] = (size_mb(tag) - base_mb, seconds)
        say(f"built {tag}: {built[name][0]:.0f} MB beyond the base, {seconds:.0f} s")
    return built


if __name__ == "__main__":
    try:
        prepare_engine(os.environ)
        build_all()
    except VerificationError as error:
        print(f"images: {error}", file=sys.stderr)
        sys.exit(2)
