"""The installer of the bundle, run on a small bundle; the commands that would change this machine are written down."""

import hashlib
import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.docs.commands import ROOT

UNIT = "tactile-insertion@.service"
PAGE = ROOT / "docs" / "deployment.md"
NOTE = '#!/bin/sh\necho "$(basename "$0") $* [$(cat "$PREFIX/app/version")]" >>"$CALLS"\n'


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """A bundle without wheels, next to an installed version."""
    bundle = tmp_path / "bundle"
    files = {"app/requirements/run.txt": "", "app/version": "new", "wheels/none": ""}
    files |= {UNIT: (ROOT / "docker" / "systemd" / UNIT).read_text()}
    for name, text in files.items():
        (bundle / name).parent.mkdir(parents=True, exist_ok=True)
        (bundle / name).write_text(text)
    sums = [f"{hashlib.sha256(text.encode()).hexdigest()}  {name}\n" for name, text in files.items()]
    (bundle / "SHA256SUMS").write_text("".join(sums))
    (bundle / "install.sh").write_bytes((ROOT / "docker" / "install.sh").read_bytes())
    (tmp_path / "prefix" / "venv").mkdir(parents=True)
    (tmp_path / "prefix" / "app").mkdir()
    (tmp_path / "prefix" / "app" / "version").write_text("old")
    return bundle


def installed(bundle: Path, typed: str = "") -> list[str]:
    """Install it; the changes that it asked of the machine, each with the version installed at that moment.

    ``typed``: the folder as it is typed, if not in full.
    """
    home = bundle.parent
    for command in ("systemctl", "useradd", "install", "id"):
        (home / command).write_text(NOTE)
        (home / command).chmod(0o755)
    subprocess.run(["sh", bundle / "install.sh", "--prefix", typed or home / "prefix"], **noted(home), check=True)
    return (home / "calls").read_text().splitlines()


def noted(home: Path) -> dict[str, Any]:
    """Where a command runs whose changes to the machine are to be written down."""
    paths = {"PATH": f"{home}:{os.environ['PATH']}", "CALLS": str(home / "calls"), "PREFIX": str(home / "prefix")}
    return {"env": os.environ | paths, "cwd": home}


def unit_of_the_old_version(bundle: Path) -> Path:
    """The old version's unit; the installer writes beside it from now on, instead of in this machine's /etc."""
    unit = bundle.parent / "etc" / "systemd" / "system" / UNIT
    unit.parent.mkdir(parents=True)
    unit.write_text("old")
    script = bundle / "install.sh"
    script.write_text(script.read_text().replace(" /etc/", f" {bundle.parent}/etc/"))
    return unit


def test_an_upgrade_restarts_the_services_that_run_once_the_new_version_lies_there(bundle: Path) -> None:
    calls = [call for call in installed(bundle) if call.startswith("systemctl")]
    assert calls == ["systemctl daemon-reload [new]", "systemctl try-restart tactile-insertion@* [new]"]
    assert (bundle.parent / "prefix" / "app.old" / "version").read_text() == "old"


def test_the_same_bundle_once_more_leaves_the_version_to_go_back_to(bundle: Path) -> None:
    unit = unit_of_the_old_version(bundle)
    installed(bundle)
    unit.write_text("new")
    prefix = bundle.parent / "prefix"
    (prefix / "app" / "version").write_text("damaged")
    assert installed(bundle)[-1] == "systemctl try-restart tactile-insertion@* [new]"
    assert (prefix / "app.old" / "version").read_text() == "old"
    assert (prefix / f"{UNIT}.old").read_text() == "old"
    assert sorted(path.name for path in prefix.iterdir() if path.is_dir()) == ["app", "app.old", "venv", "venv.old"]


@pytest.mark.parametrize("typed", ["", "prefix"])
def test_the_unit_runs_what_was_installed_wherever_that_is(bundle: Path, typed: str) -> None:
    prefix = bundle.parent / "prefix"
    calls = installed(bundle, typed)
    unit = (prefix / UNIT).read_text()
    assert f"install -D -m 644 {prefix / UNIT} /etc/systemd/system/{UNIT} [new]" in calls
    assert f"ExecStart={prefix}/venv/bin/python -m service run" in unit
    assert "/opt/" not in unit


def test_the_way_back_on_the_page_brings_the_old_version_with_its_own_unit(bundle: Path) -> None:
    """A new unit may name folders that the old version does not have: its start would fail."""
    unit_of_the_old_version(bundle)
    installed(bundle)
    prefix = bundle.parent / "prefix"
    assert (prefix / f"{UNIT}.old").read_text() == "old"
    way = re.findall(r"```sh\n(cd /opt/tactile-insertion\n.*?)```", PAGE.read_text(), re.DOTALL)[-1]
    way = way.replace("sudo ", "").replace("/opt/tactile-insertion", str(prefix))
    subprocess.run(["sh", "-e", "-c", way], **noted(bundle.parent), check=True)
    calls = (bundle.parent / "calls").read_text().splitlines()
    assert calls[-3:] == [
        f"install -m 644 {UNIT}.old /etc/systemd/system/{UNIT} [old]",
        "systemctl daemon-reload [old]",
        "systemctl try-restart tactile-insertion@* [old]",
    ]


def test_what_cannot_be_compiled_as_on_a_full_disk_leaves_the_running_version(bundle: Path) -> None:
    (bundle / "app" / "broken.py").write_text("(")
    with pytest.raises(subprocess.CalledProcessError):
        installed(bundle)
    assert (bundle.parent / "prefix" / "app" / "version").read_text() == "old"


def test_what_a_hardened_machine_installs_can_be_read_by_the_user_of_the_service(bundle: Path) -> None:
    (bundle / "app" / "version").chmod(0o600)
    before = os.umask(0o077)
    try:
        installed(bundle)
    finally:
        os.umask(before)
    hidden = [path for path in (bundle.parent / "prefix").rglob("*") if not path.stat().st_mode & 0o004]
    assert hidden == []
