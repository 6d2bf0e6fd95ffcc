"""Wrong numbers at the simulator's command line: one line that names the option, and nothing is written."""

import os
from pathlib import Path

import pytest

from simulation.__main__ import COMMANDS, main
from tests.simulation.strategies import made_up_dataset, made_up_trial

ON_A_WORLD = (
    "evaluate --models MODELS --json OUT/rows.json",
    "trust --drawn-n 0 --out OUT",
    "commission --objects rectangle --json OUT/rows.json",
)
REFUSED = [
    ("collect --out OUT --workers -1", "--workers"),
    ("collect --out OUT --seed -1", "--seed"),
    ("collect --out OUT --held-out-share nan", "--held-out-share"),
    ("export-dataset DATA --out OUT --count -1", "--count -1"),
    ("export-dataset DATA --out OUT --first -3", "--first -3"),
    ("evaluate --models MODELS --json OUT/rows.json --count 0", "--count 0"),
    ("evaluate --models OUT --json OUT/rows.json", "no *.step.onnx there"),
    ("evaluate --models MODELS --json OUT/rows.json --objects", "nothing to play"),
    ("run --timeout-s nan --out OUT", "--timeout-s nan"),
    ("run --x-mm nan --out OUT", "--x-mm nan"),
    ("run --fps 45 --out OUT", "--fps 45"),
    ("run --models DATA --out OUT", "no folder with .onnx files"),
    ("run --client LOOSE --out OUT", "nothing: expected tables"),
    ("demo --client LOOSE --out OUT", "nothing: expected tables"),
    ("demo --port 99999 --out OUT", "--port 99999"),
    ("demo --parts 0 --out OUT", "--parts 0"),
    ("cell --seed -1 --out OUT", "--seed -1"),
    ("probe rectangle --x-mm 1e308", "--x-mm 1e+308"),
    ("probe rectangle --seed -1", "--seed -1"),
    ("evaluate --models MODELS --json OUT/rows.json --seed=-1", "--seed -1"),
    ("drawn-worlds --models MODELS --out OUT --drawn-n 0", "--drawn-n 0"),
    ("trust --models MODELS --out OUT --drawn-n 0", "--drawn-n 0"),
    ("choose --seconds-a-box 10 --success 95 --world MINI --out OUT", "a share above 0 up to 1"),
    ("choose --seconds-a-box 10 --world MINI --objects nowhere --out OUT", "no object 'nowhere'"),
    *((f"{line} --worlds MINI", "pictures of the sensor gelsight_mini") for line in ON_A_WORLD),
    ("commission --worlds MINI --objects rectangle --json DATA", "is a folder"),
]


@pytest.fixture(scope="module")
def folders(tmp_path_factory, models_folder) -> dict[str, Path]:
    data = made_up_dataset(tmp_path_factory.mktemp("data"), [made_up_trial(k) for k in range(12)])
    loose = data.with_name("loose.toml")
    loose.write_text("nothing = 1")
    mini = data.with_name("mini.toml")
    mini.write_text('[camera]\nsensor = "gelsight_mini"')
    return {"DATA": data, "MODELS": models_folder, "LOOSE": loose, "MINI": mini}


@pytest.mark.parametrize(("line", "named"), REFUSED, ids=[line for line, _ in REFUSED])
def test_a_number_that_cannot_be_is_named_and_nothing_is_written(folders, tmp_path, capsys, line, named) -> None:
    places = {**folders, "OUT": tmp_path / "out"}
    assert main([str(places.get(word, word.replace("OUT", str(places["OUT"])))) for word in line.split()]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert named in lines[0]
    assert not (tmp_path / "out").exists()


def test_a_cell_whose_folder_cannot_be_made_says_so_before_anything_runs(tmp_path, capsys) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    assert main(["cell", "--out", str(taken)]) == 2
    assert str(taken) in capsys.readouterr().err


def test_a_command_computes_on_one_thread_as_its_workers_do(monkeypatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert main(["evalute"]) == 2
    assert (os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_NUM_THREADS"]) == ("1", "2"), "what is set stays"


def test_a_misspelt_command_is_refused_with_the_nearest_one(capsys) -> None:
    assert main(["evalute"]) == 2
    assert capsys.readouterr().err == "simulation: unknown command 'evalute'; did you mean 'evaluate'?\n"


@pytest.mark.parametrize(("name", "goes_on"), [("collect", True), ("accuracy", False)])
def test_an_interrupt_tells_whether_the_command_goes_on(monkeypatch, capsys, name, goes_on) -> None:
    def interrupted(_words: list[str]) -> int:
        raise KeyboardInterrupt

    module, function = COMMANDS[name][0].split(":")
    monkeypatch.setattr(f"simulation.cli.{module}.{function}", interrupted)
    assert main([name]) == 130
    assert ("goes on" in capsys.readouterr().err) == goes_on
