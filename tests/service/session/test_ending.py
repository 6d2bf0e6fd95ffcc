"""What is kept and told of insertions as they open, end or cannot be recorded. No camera has shown anything yet."""

import json
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from service.cameras.capture import CameraFrame
from service.contract import TactileFrame, wire
from service.decision.models import ModelSet
from service.observability.hub import Hub
from service.session import manager as under_test
from service.session.insertion import Insertion
from service.session.manager import InsertionManager
from tests.service import drawn
from tests.service.session.driving import Cell, Client, wait_for_recorders


def test_what_belongs_to_an_insertion_reaches_it(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    cell.client.connect("one")
    called: list[Any] = []
    monkeypatch.setattr(Insertion, "result", lambda _, result: called.append(result))
    monkeypatch.setattr(Insertion, "camera_fault", lambda _, code, detail: called.append((code, detail)))
    cell.manager.result("result")
    cell.manager.fault("camera_lost", "left is gone")
    assert called == ["result", ("camera_lost", "left is gone")]
    cell.manager.active.received_ns = 0  # type: ignore[union-attr]
    cell.manager.tick(round(cell.manager.settings.client_timeout_s * 1e9) - 1)
    assert cell.manager.active is not None


def test_the_last_insertions_are_remembered_for_a_client_that_missed_their_end(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(under_test, "REMEMBERED_N", 2)
    for name in ("one", "two", "three"):
        assert cell.ends(name).heard[-1].type == "finished"
    late = Client(cell.manager)
    assert [late.connect(name).insertion_id for name in ("three", "two")] == ["three", "two"]
    assert [message.type for message in late.heard] == ["finished", "finished"]
    cell.manager.receive(wire.ClientHeartbeat(insertion_id="three", count=4), late.send)
    cell.manager.receive(wire.ClientHeartbeat(insertion_id="one", count=5), late.send)
    cell.manager.receive(wire.Abort(insertion_id="three", cause="operator", reason="again"), late.send)
    assert [message.type for message in late.heard[2:]] == ["heartbeat"]
    assert late.connect("one").type == "hello", "forgotten"
    assert cell.manager.opened_n == 4


def test_an_insertion_ends_in_this_order_and_its_client_hears_it_once_it_is_all_on_disk(cell: Cell) -> None:
    on_disk = []
    cell.client.connect("one")
    cell.manager.active.send = lambda message: on_disk.append((message.type, recorded(cell)))  # type: ignore[union-attr]
    cell.manager.abort("operator", "done")
    cell.manager.abort("operator", "once more")
    wait_for_recorders()
    assert on_disk == [("finished", True)]
    assert [kind for kind in cell.kinds if kind in {"finished", "recorded"}] == ["finished", "recorded"]
    (summary,) = (cell.manager.settings.recordings).glob("*/summary.json")
    kept = json.loads(summary.read_text())
    assert (kept["insertion_id"], kept["outcome"], kept["attempts"]) == ("one", "aborted", 0)


def recorded(cell: Cell) -> bool:
    return bool(list(cell.manager.settings.recordings.glob("*/insertion.mcap")))


def test_an_insertion_that_cannot_be_recorded_is_made_all_the_same_counted_and_named(
    cell: Cell, tmp_path: Path
) -> None:
    (tmp_path / "r").rmdir()
    (tmp_path / "r").write_text("a file where the folder was")
    assert cell.client.connect("one").type == "hello"
    assert cell.manager.active is not None
    assert cell.manager.active.session.recording is None
    assert cell.manager.unrecorded.startswith(f"cannot record into {tmp_path / 'r'}: ")
    assert cell.manager.recording_problem == f"the folder {tmp_path / 'r'} is missing"
    assert (cell.manager.unrecorded_n, cell.kinds) == (1, ["unrecorded", "client", "message"])
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    (tmp_path / "r").unlink()
    (tmp_path / "r").mkdir()
    cell.client.connect("two")
    assert cell.manager.active.session.recording is not None
    assert cell.manager.recording_problem == "", "the cause has gone"
    assert cell.manager.unrecorded != "", "until one has been recorded completely"
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    assert (cell.manager.unrecorded, cell.manager.unrecorded_n) == ("", 1)


def test_a_recording_that_broke_is_named_while_and_after_it_is_written(cell: Cell) -> None:
    cell.client.connect("one")
    recorder = cell.manager.active.recorder  # type: ignore[union-attr]
    assert cell.manager.recording_problem == ""
    recorder.error = "no space left"  # type: ignore[union-attr]
    assert cell.manager.recording_problem == f"recording {recorder.path}: no space left"
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    assert cell.manager.recording_problem == "", "nothing is in the way of the next one"
    assert cell.manager.unrecorded.endswith(": no space left")
    assert [content for kind, content in cell.events if kind == "unrecorded"] == [cell.manager.unrecorded]


def test_frames_that_were_left_out_are_counted_and_named(cell: Cell) -> None:
    cell.client.connect("one")
    recorder = cell.manager.active.recorder  # type: ignore[union-attr]
    recorder.largest_bytes = 1  # type: ignore[union-attr]
    noise = np.random.default_rng(0).integers(0, 255, (320, 427, 3), np.uint8)
    for number in range(3):
        recorder.frame(CameraFrame(TactileFrame("left", number, number + 1, noise), None))  # type: ignore[union-attr]
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    lacks = "3 frames and observations were left out: the file reached its limit of 0 MB"
    assert cell.manager.unrecorded.endswith(f": {lacks}")
    assert (cell.manager.unrecorded_n, cell.manager.frames_unrecorded_n, cell.manager.recording_problem) == (1, 3, "")
    summary = json.loads((recorder.folder / "summary.json").read_text())  # type: ignore[union-attr]
    assert summary["problem"] == lacks
    cell.client.connect("two")
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    assert (cell.manager.unrecorded, cell.manager.unrecorded_n) == ("", 1)


def test_recordings_may_fill_as_many_gigabytes_as_are_set(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(under_test, "make_room", lambda _root, most_bytes: asked.append(most_bytes) or "")
    cell.ends("one")
    assert asked == [20_000_000_000]


def test_the_oldest_recordings_go_before_an_insertion_opens_whose_client_waits_only_so_long(
    tmp_path: Path, models: ModelSet
) -> None:
    def old(name: str) -> Path:
        folder = tmp_path / "r" / name
        folder.mkdir(parents=True)
        (folder / "insertion.mcap").write_bytes(b"\0" * 900_000)
        return folder

    first, second = old("20260101T000000_a"), old("20260101T000001_b")
    cell = Cell(tmp_path, models, recordings_max_gb=0.001)
    assert (first.exists(), second.exists()) == (False, True), "at the start: its limit may be a lower one"
    third = old("20260101T000002_c")
    cell.client.connect()
    assert second.exists()
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    assert (second.exists(), third.exists()) == (False, False)
    assert len(list((tmp_path / "r").glob("*_one"))) == 1


def test_recordings_that_cannot_be_removed_are_no_secret(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.recordings.retention.prune", lambda *_: Path("/proc/1/root/x").stat())
    cell.ends("one")
    assert cell.events[-1][0] == "error"
    assert cell.events[-1][1].startswith("no old recording can be removed: ")


def test_an_alarm_of_the_charts_is_told_with_its_remedy_and_a_chart_that_cannot_be_kept_with_its_error(
    cell: Cell, models: ModelSet
) -> None:
    cause = SimpleNamespace(what="the light has changed", remedy="look at the lamp")
    added: list[Any] = []
    cell.manager.charts = SimpleNamespace(  # type: ignore[assignment]
        add=lambda values, name, within: added.append((values, name, within)) or [("light", cause)],
        keep=lambda: added.append("kept"),
    )
    ended = {"insertion_id": "one", "outcome": "inserted", "attempts": 2, "brightness_grey": 130.0}
    cell.manager._chart(ended, models)
    (values, name, within), kept = added
    assert kept == "kept"
    assert (values["light"], name) == (130.0, "")
    assert within == " ".join(entry.sha256[:12] for entry in models.entries), "other networks begin new charts"
    alarm = {"chart": "light", "cause": "the light has changed", "remedy": "look at the lamp"}
    assert cell.events == [("drift", alarm)]
    cell.manager._chart({"outcome": "nonsense"}, models)
    assert cell.kinds == ["drift", "error"]


def test_gels_are_known_by_what_was_measured_of_them(tmp_path: Path, models: ModelSet) -> None:
    plain = drawn.calibration()
    calibration: Any = SimpleNamespace(
        camera=lambda finger: SimpleNamespace(
            measured=None if finger == "left" else SimpleNamespace(fingerprint=None), raw=plain.left.raw
        )
    )
    made = Cell(tmp_path, models).manager
    known = InsertionManager(made.settings, models, calibration, made.cameras, Hub(), lambda _: None)
    assert [entry.gel for entry in known.camera_entries()] == ["", ""]


def test_a_message_for_an_insertion_that_just_ended_starts_no_thread(cell: Cell) -> None:
    cell.ends("one")
    before = threading.active_count()
    cell.manager._close(wire.Finished(insertion_id="one", outcome="aborted", attempts=0))
    assert threading.active_count() == before
