"""Networks are compared on the same presses, read as deep as the software presses."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from service.contract import ContractError
from simulation.cli.dataset import collect
from training.data.dataset import data_sha256, open_source
from training.fit.checkpoint import Checkpoint
from training.report.transfer import write_transfer

RELEASE = Path(__file__).parents[3] / "models" / "pressing" / "checkpoint.pt"
PLAN = """
[[trained]]
name = "release"
checkpoint = "{release}"
presses = 9400
cpu_ms = 200
[[trained]]
name = "other"
checkpoint = "{other}"
presses = 9400
cpu_ms = 200
[[test_sets]]
name = "bristle"
data = "{data}"
"""


@pytest.fixture(scope="module")
def presses(tmp_path_factory):
    folder = tmp_path_factory.mktemp("presses") / "bristle"
    arguments = ["--objects", "drawn-bristle", "--trials-per-object", "10", "--workers", "1"]
    assert collect([*arguments, "--out", str(folder)]) == 0
    return folder


def compared(tmp_path, monkeypatch, presses, other):
    monkeypatch.chdir(tmp_path)  # the cache lies in the working folder
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN.format(release=RELEASE, other=other, data=presses))
    write_transfer(plan, tmp_path)
    release, second = json.loads((tmp_path / "transfer.json").read_text())["rows"]
    return release, second


def test_the_same_network_gains_nothing(tmp_path, monkeypatch, presses):
    release, same = compared(tmp_path, monkeypatch, presses, RELEASE)
    assert same["gained"] == [0.0, 0.0, 0.0]
    assert {**same, "name": "release"} == release


def test_a_network_that_turns_its_directions_around_loses_them(tmp_path, monkeypatch, presses):
    trained = Checkpoint.load(RELEASE)
    reversed_head = {f"direction.{part}": -trained.weights[f"direction.{part}"] for part in ("weight", "bias")}
    replace(trained, weights={**trained.weights, **reversed_head}).save(tmp_path / "reversed.pt")
    release, other = compared(tmp_path, monkeypatch, presses, tmp_path / "reversed.pt")
    assert other["direction"][0] < release["direction"][0]
    assert other["gained"][0] == pytest.approx(other["direction"][0] - release["direction"][0])
    assert other["mae_x_mm"] == release["mae_x_mm"]


def test_a_network_that_was_trained_on_a_test_set_is_refused_by_name(tmp_path, monkeypatch, presses):
    trained = replace(Checkpoint.load(RELEASE), training_data_sha256=data_sha256(open_source(str(presses))))
    trained.save(tmp_path / "trained.pt")
    with pytest.raises(ContractError, match="other was trained on the test set bristle; expected fresh presses"):
        compared(tmp_path, monkeypatch, presses, tmp_path / "trained.pt")
    assert not (tmp_path / "transfer.json").exists()


def test_a_network_that_reads_no_depth_is_refused_by_name(tmp_path, monkeypatch, presses):
    replace(Checkpoint.load(RELEASE), pressing=None).save(tmp_path / "markers.pt")
    with pytest.raises(ContractError, match="other is a pressing network, expected one that reads steps of depth"):
        compared(tmp_path, monkeypatch, presses, tmp_path / "markers.pt")


def test_a_plan_with_a_wrong_key_is_refused_by_name(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN.format(release=RELEASE, other=RELEASE, data=tmp_path).replace("presses = 9400", "pokes = 3"))
    with pytest.raises(ContractError, match=r"trained\.0\.\w+: "):
        write_transfer(plan, tmp_path)
