"""Invalid input at the command line: named in one line, refused, and no existing byte overwritten."""

import json
import re
import sys

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from export.cli.commands import main as export_main
from service.contract import ContractError, Sensor
from service.durable import locked
from simulation.data.manifest import MANIFEST, ShardEntry
from tests.simulation.strategies import made_up_dataset, made_up_trial
from tests.training.conftest import MARKERS
from tests.training.data.test_episodes import recorded
from training.cli.commands import COMMANDS, main
from training.data.labels import CLASSES
from training.fit.checkpoint import Checkpoint
from training.fit.train import train
from training.metrics.figures import Scales
from training.networks import build

SHARD = "rectangle-00001.parquet"
CONFIG = """name = "mine"
runs = "{runs}"
[data]
path = "{data}"
cache = "{cache}"
rendered_training = 2
rendered_validation = 2
rendered_test = 2
[network]
kind = "markers"
trunk_width = 8
feature_size = 16
state_size = 16
[trunk]
epochs = 1
"""


@pytest.fixture
def probes(tmp_path):
    return made_up_dataset(tmp_path / "probes", [made_up_trial(k) for k in range(24)])


@pytest.fixture
def run_file(tmp_path, probes):
    path = tmp_path / "mine.toml"
    path.write_text(CONFIG.format(runs=tmp_path / "runs", data=probes, cache=tmp_path / "cache"))
    kept = tmp_path / "runs" / "mine" / "checkpoint.pt"
    kept.parent.mkdir(parents=True)
    kept.write_bytes(b"the good run of last week")
    return path


def refusal(monkeypatch, capsys, run, *arguments):
    """The one line on which a command ends with exit code 2."""
    monkeypatch.setattr(sys, "argv", ["prog", *map(str, arguments)])
    assert run() == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def contents(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def truncated(probes):
    (probes / SHARD).write_bytes((probes / SHARD).read_bytes()[:-1000])


def of_another_version(probes):
    stated = json.loads((probes / MANIFEST).read_text())
    (probes / MANIFEST).write_text(json.dumps(stated | {"schema_version": 99}))


def listed_twice(probes):
    stated = json.loads((probes / MANIFEST).read_text())
    (probes / MANIFEST).write_text(json.dumps(stated | {"shards": [*stated["shards"], stated["shards"][1]]}))


def edited(probes, column, value):
    """Change the fourth row of a shard, and list it as if it had been written so."""
    table = pq.read_table(probes / SHARD)
    place = table.column_names.index(column)
    values = table.column(place).to_pylist()
    values[3] = value
    changed = pa.array(values, table.schema.field(place).type)
    pq.write_table(table.set_column(place, table.schema.field(place), changed), probes / SHARD)
    stated = json.loads((probes / MANIFEST).read_text())
    entry = next(entry for entry in stated["shards"] if entry["name"] == SHARD)
    fresh = ShardEntry.of(SHARD, (probes / SHARD).read_bytes(), trials=12, object_name="rectangle", outcomes={})
    entry |= {"size_bytes": fresh.size_bytes, "sha256": fresh.sha256}
    (probes / MANIFEST).write_text(json.dumps(stated))


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (truncated, rf"{SHARD}.*truncated\?"),
        (of_another_version, f"{MANIFEST}.*schema version 99, expected 2"),
        (lambda probes: edited(probes, "theta_deg", float("nan")), rf"{SHARD}.*theta_deg"),
        (lambda probes: edited(probes, "split", "dev"), rf"{SHARD}: trial 15 .*'dev', expected one of train"),
        (lambda probes: edited(probes, "onset_frame", 99), rf"{SHARD}: trial 15 .*onset_frame 99, expected 0\.\.22"),
        (lambda probes: edited(probes, "appearances", "{}"), rf"{SHARD}: trial 15 cannot be read"),
        (listed_twice, f"{SHARD} is listed twice"),
    ],
)
def test_data_that_cannot_be_used_are_named_and_refused(probes, run_file, tmp_path, monkeypatch, capsys, damage, named):
    damage(probes)
    before = contents(tmp_path)
    assert re.search(named, refusal(monkeypatch, capsys, main, "train", run_file))
    assert before.items() <= contents(tmp_path).items()


@pytest.mark.parametrize("run", [main, export_main])
def test_a_folder_that_cannot_be_written_is_one_line(probes, run_file, tmp_path, monkeypatch, capsys, run):
    taken, sound = tmp_path / "taken", tmp_path / "sound.pt"
    taken.write_text("a file")
    run_file.write_text(CONFIG.format(runs=taken, data=probes, cache=tmp_path / "cache"))
    weights = build(MARKERS, len(CLASSES), Sensor.load()).state_dict()
    Checkpoint("sound", MARKERS, weights, Scales(), Scales(), {}, "0" * 64, "none").save(sound)
    words = ("train", run_file) if run is main else ("onnx", sound, "--out", taken, "--force")
    line = refusal(monkeypatch, capsys, run, *words)
    assert str(taken) in line
    assert "Errno" not in line


@pytest.fixture
def foreign(tmp_path):
    """A checkpoint whose weights do not have the stated size."""
    weights = build(MARKERS.model_copy(update={"state_size": 24}), len(CLASSES), Sensor.load())
    path = tmp_path / "foreign.pt"
    Checkpoint("foreign", MARKERS, weights.state_dict(), Scales(), Scales(), {}, "0" * 64, "none").save(path)
    return path


def test_a_checkpoint_of_another_architecture_is_not_exported(foreign, tmp_path, monkeypatch, capsys):
    released = tmp_path / "models" / "direction.step.onnx"
    released.parent.mkdir()
    released.write_bytes(b"the released one")
    line = refusal(monkeypatch, capsys, export_main, "onnx", foreign, "--out", released.parent, "--force")
    assert "foreign holds another architecture than markers" in line
    assert contents(released.parent) == {released: b"the released one"}


STRANGERS = {"weights of other layers": {"network": {"strange": torch.zeros(3)}}, "something else": {"weights": 3}}


@pytest.mark.slow
@pytest.mark.parametrize("stored", STRANGERS.values(), ids=STRANGERS)
def test_a_run_does_not_go_on_from_a_stranger(config, source, tmp_path, stored):
    strange = config.folder / "front.resume.pt"
    strange.parent.mkdir(parents=True)
    torch.save(stored, strange)
    before = contents(config.folder)
    with pytest.raises(ContractError, match=r"front\.resume\.pt holds another architecture, expected this run's"):
        train(config, source)
    assert before.items() <= contents(config.folder).items()


def test_a_run_does_not_go_on_from_a_file_cut_short(config, source):
    cut = config.folder / "front.resume.pt"
    cut.parent.mkdir(parents=True)
    cut.write_bytes(b"PK\x03\x04 and then the disk was full")
    with pytest.raises(ContractError, match=r"front\.resume\.pt cannot be read"):
        train(config, source)
    assert cut.read_bytes().endswith(b"full")


def test_the_comparison_of_an_adaptation_is_written_into_a_new_folder(tmp_path):
    """The fit takes minutes, and an accepted network must not end as invalid input."""
    compared = tmp_path / "new" / "compared.json"
    words = ["adapt", recorded(tmp_path / "few", 7), "--from", "models/pressing/checkpoint.pt"]
    assert main([*map(str, words), "--out", str(tmp_path / "out"), "--json", str(compared)]) == 3
    assert json.loads(compared.read_text())["accepted"] is False


def test_two_adaptations_do_not_write_one_checkpoint(tmp_path, capsys):
    words = ["adapt", str(tmp_path), "--from", "models/pressing/checkpoint.pt", "--out", str(tmp_path)]
    with locked(tmp_path):
        assert main(words) == 2
    assert f"{tmp_path}: another process is training there" in capsys.readouterr().err


def test_what_would_lose_an_adaptation_at_its_end_is_refused_before_it(tmp_path, monkeypatch, capsys):
    taken = tmp_path / "taken"
    taken.write_text("a file")
    words = ["adapt", recorded(tmp_path / "few", 7), "--from", "models/pressing/checkpoint.pt", "--out"]
    assert str(taken) in refusal(monkeypatch, capsys, main, *words, taken)
    expected = f"--json {tmp_path} is a folder, expected a file"
    assert expected in refusal(monkeypatch, capsys, main, *words, tmp_path / "out", "--json", tmp_path)
    assert "--seed -1: expected 0 to" in refusal(monkeypatch, capsys, main, *words, tmp_path / "out", "--seed", "-1")


@pytest.mark.parametrize(("name", "promised"), [("train", "; the same command goes on"), ("adapt", "")])
def test_only_what_is_resumed_is_promised_to_go_on(name, promised, monkeypatch, capsys):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setitem(COMMANDS, name, interrupted)
    assert main([name]) == 130
    assert capsys.readouterr().err == f"{name}: interrupted{promised}\n"
