"""A run's scalars on TensorBoard, read back with TensorBoard's own reader."""

import json
import threading
import time

import pytest

from service.contract import ContractError
from tests.waiting import wait_for
from training.cli.commands import main
from training.report import boards

EPOCHS = [{"stage": "trunk", "epoch": k, "loss": 2.0 / (k + 1), "score": 1.0 - 0.1 * k} for k in range(3)]


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in EPOCHS))
    return folder


def test_tensorboard_shows_every_scalar_of_every_epoch(run, capsys):
    pytest.importorskip("tensorboard", reason="tensorboard is not installed")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    assert main(["board", "tensorboard", str(run)]) == 0
    assert "3 epochs" in capsys.readouterr().out
    shown = EventAccumulator(str(run / "tensorboard")).Reload()
    assert set(shown.Tags()["scalars"]) == {"trunk/loss", "trunk/score"}
    losses = {event.step: event.value for event in shown.Scalars("trunk/loss")}
    assert losses == pytest.approx({line["epoch"]: line["loss"] for line in EPOCHS})


def test_a_line_that_is_being_written_is_waited_for(run, monkeypatch):
    monkeypatch.setattr(boards, "PERIOD_S", 0.01)
    log = run / "log.jsonl"
    with log.open("a") as file:
        file.write('{"stage": "trunk", "epo')
    heard = []

    def listen():
        for line in boards.lines(log, follow=True):
            heard.append(line["epoch"])
            if len(heard) == 4:
                return

    thread = threading.Thread(target=listen)
    thread.start()
    wait_for(lambda: len(heard) >= 3)
    time.sleep(0.1)
    assert heard == [0, 1, 2], "half a line is none"
    with log.open("a") as file:
        file.write('ch": 3, "loss": 0.5}\n')
    wait_for(lambda: heard == [0, 1, 2, 3])
    thread.join()


def test_a_line_that_a_kill_cut_off_hides_no_other(run):
    with (run / "log.jsonl").open("a") as file:
        file.write('{"stage": "trunk", "epo' + json.dumps({"epoch": 3}) + "\n" + json.dumps({"epoch": 4}) + "\n")
    assert [line["epoch"] for line in boards.lines(run / "log.jsonl", follow=False)] == [0, 1, 2, 4]


def test_a_folder_that_never_trained_is_refused(tmp_path):
    with pytest.raises(ContractError, match=r"log\.jsonl is missing: expected the folder of a run"):
        boards.show_on("tensorboard", tmp_path)


def test_a_board_that_is_not_installed_says_how_to_get_it(run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trackio", None)
    with pytest.raises(ContractError, match=r"trackio is not installed .*pip install trackio"):
        boards.show_on("trackio", run)
