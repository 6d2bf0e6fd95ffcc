"""The commands of compose.yaml's robot clients, given to the client itself with the volumes as folders."""

import re
from pathlib import Path

import pytest
import yaml

from robot_client.cli import main as command_line
from robot_client.cli.terminal import Outcome
from robot_client.session.commission.record import RECORD, Record, keep_record
from simulation.cell.config import client_config
from tests.docs.commands import ROOT
from tests.robot_client.session.test_wiring import answers

SERVICES = yaml.safe_load((ROOT / "docker" / "compose.yaml").read_text())["services"]
FACTS = {
    "egm_guide_port": 6599,
    "rws_url": "http://127.0.0.1:8199",
    "rapid": {},
    "gripper": "127.0.0.1:1099",
    "object": "circle",
    "gap_width_mm": 51.5,
    "neighbours_stay": True,
    "expected_depth_mm": 24.0,
    "creep_allowance_mm": 4.0,
    "approach": {"z_mm": 33.0},
    "home": {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 43.0, "yaw_deg": 0.0},
}


def filled(text: str) -> str:
    """The text as compose reads it where no variable is set."""
    return re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)


def words_of(name: str) -> list[str]:
    """The command of a service."""
    return [filled(word) for word in SERVICES[name]["command"]]


def valued(words: list[str], option: str) -> str:
    """The value of ``--option=VALUE``."""
    (value,) = (word.partition("=")[2] for word in words if word.startswith(f"{option}="))
    return value


def outside(name: str, inside: str, volumes: Path) -> Path:
    """The file of a container's path, with each volume as a folder below ``volumes``; fails if no volume holds it."""
    for mount in SERVICES[name]["volumes"]:
        volume, where = filled(mount).split(":")[:2]
        if Path(inside).is_relative_to(where):
            return volumes / volume / Path(inside).relative_to(where)
    pytest.fail(f"{name}: no volume holds {inside}")


class Client:
    """The client's command line up to the insertion, whose settings, plan and mode are kept."""

    def __init__(self, volumes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.volumes, self.inserted = volumes, []
        monkeypatch.setattr(command_line, "insert", self._insert)

    def _insert(self, settings, plan, *, live, **_):
        self.inserted.append((settings, plan, live))
        return Outcome(True, {})

    def runs(self, name: str, words: list[str]) -> int:
        """Exit code of a command in a service's container."""
        return command_line.main([self._outside(name, word) for word in words])

    def _outside(self, name: str, word: str) -> str:
        option, _, value = word.partition("=")
        return f"{option}={outside(name, value, self.volumes)}" if value.startswith("/") else word


@pytest.fixture
def client(tmp_path, monkeypatch):
    return Client(tmp_path, monkeypatch)


def write(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


def test_the_simulated_profile_inserts_with_what_its_cell_wrote(client):
    folder = valued(words_of("cell"), "--out")
    write(outside("cell", f"{folder}/cell.toml", client.volumes), client_config(FACTS, "http://127.0.0.1:1", None))
    assert client.runs("robot-client-sim", words_of("robot-client-sim")) == 0
    ((settings, plan, live),) = client.inserted
    assert live
    assert settings.simulated
    assert (settings.robot.port, settings.gripper.port) == (6599, 1099)
    port = filled(SERVICES["service-sim"]["environment"]["TACTILE_PORT"])
    assert settings.service.url == f"ws://127.0.0.1:{port}/v1/insertion"
    assert (plan.approach.z_mm, plan.gap_width_mm, plan.expected_depth_mm) == (33.0, 51.5, 24.0)
    assert plan.neighbours_stay


@pytest.mark.parametrize("commissioned", [False, True])
def test_a_real_cell_inserts_only_with_the_record_that_commissioning_left_in_a_volume(
    client, monkeypatch, capsys, commissioned
):
    """`commission` writes below the directory in which the container works; the configuration names it from there."""
    workdir = re.findall(r"^WORKDIR (\S+)$", (ROOT / "docker" / "robot_client.Dockerfile").read_text(), re.MULTILINE)
    works_in = outside("robot-client", workdir[-1], client.volumes)
    works_in.mkdir(parents=True)
    monkeypatch.chdir(works_in)
    record = Path("runs", "commissioning", RECORD)
    config = "/etc/tactile/cell.toml"
    write(outside("robot-client", config, client.volumes), f'commissioning = "{record}"\n[lease]\nstop_lag_s = 0.04\n')
    if commissioned:
        gels = {"left": "a", "right": "b"}
        keep_record(record, Record(begun="today", seed=1, signs=tuple(answers()), gels=gels))
    code = client.runs("robot-client", ["insert", "--live", f"--config={config}", "--x-mm=8"])
    assert (code, len(client.inserted)) == ((0, 1) if commissioned else (2, 0))
    assert commissioned or "commission --live" in capsys.readouterr().err


def test_the_backup_on_the_page_runs_in_the_image_that_the_cell_has():
    """After an upgrade by TAG, or where images come from a registry, a fixed name may be that of no image any more."""
    (backup,) = [line for line in (ROOT / "docs" / "deployment.md").read_text().splitlines() if "/backup/" in line]
    assert f" {SERVICES['robot-client']['image']} " in backup
