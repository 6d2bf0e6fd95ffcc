"""The script that makes the bundle, run in a small repository, with a pip that keeps the pins instead of the wheels."""

import re
import subprocess
from pathlib import Path

from tests.docs.commands import ROOT

SCRIPT = ROOT / "docker" / "bundle.sh"
PINS = Path("requirements", "run.txt")
PYTHON = """#!/bin/sh
[ "$1" != -c ] || { echo here; exit; }
while [ "$1" != -r ]; do shift; done
cp "$2" "$4/pins.whl"
"""


def git(*words: str, folder: Path) -> None:
    who = ["-c", "user.name=a", "-c", "user.email=a@example.com"]
    subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True)


def test_the_wheels_are_those_of_the_pins_that_the_bundle_installs(tmp_path: Path) -> None:
    """Pins that were made anew and not yet committed: the bundle was whole, and could not be installed."""
    archived = re.findall(r"^git archive HEAD (.*?) \| tar", SCRIPT.read_text().replace("\\\n", " "), re.MULTILINE)
    for name in (*archived[0].split(), "docker/install.sh", "docker/systemd/unit"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text('version = "1"\n')
    git("init", folder=tmp_path)
    git("add", ".", folder=tmp_path)
    git("commit", "-m", "a", folder=tmp_path)
    (tmp_path / PINS).write_text("newer")
    python = tmp_path / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    subprocess.run(["sh", SCRIPT, python, "dist"], cwd=tmp_path, check=True)
    (bundle,) = (path for path in (tmp_path / "dist").iterdir() if path.is_dir())
    assert (bundle / "wheels" / "pins.whl").read_text() == (bundle / "app" / PINS).read_text()
