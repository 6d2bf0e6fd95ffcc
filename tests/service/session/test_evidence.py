"""Which insertions are evidence for the version that decided them: those that were recorded whole."""

import errno
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from service.contract import wire
from service.decision.models import ModelSet
from tests.service.session.driving import Cell, Client, arm, wait_for_recorders


class OtherVersions:
    """Versions as the manager sees them."""

    def __init__(self, active: ModelSet) -> None:
        self.active, self.learnt, self.asked = active, list[Any](), list[Any]()
        self.fails = False

    def beside(self, deciding: Any, *_: Any) -> Any:
        self.asked.append(deciding)
        return SimpleNamespace(active="a", decide=lambda _: {})

    def learn(self, _beside: Any, finished: wire.Finished, of: str, *, fresh: bool, tried_n: int) -> None:
        if self.fails:
            raise OSError("disk")
        self.learnt.append((finished.insertion_id, of, fresh))
        assert tried_n == 0


def test_the_version_that_decides_now_begins_an_insertion_and_the_one_before_goes_on_with_its_own(
    cell: Cell, models: ModelSet
) -> None:
    first, second = (ModelSet(models.steps, models.models) for _ in range(2))
    versions = OtherVersions(first)
    cell.manager.versions = versions  # type: ignore[assignment]
    cell.ends("one", arm())
    versions.active = second
    cell.ends("two", continues="one")
    here = wire.ToolPose(x_mm=0, y_mm=0, z_mm=0, yaw_deg=0)
    cell.ends("three", wire.Episode(insertion_id="three", object="box", start=here, approach=here))
    assert [id(deciding) for deciding in versions.asked] == [id(first), id(first), id(second)]
    assert versions.learnt == [("one", "", True), ("two", "", False), ("three", "box", True)]
    versions.fails = True
    assert cell.ends("four").heard[-1].type == "finished"
    assert ("error", "versions: disk") in cell.events


def test_insertions_without_a_recording_are_no_evidence_for_a_version(
    cell: Cell, tmp_path: Path, models: ModelSet
) -> None:
    (tmp_path / "r").rmdir()
    (tmp_path / "r").write_text("a file where the folder was")
    versions = OtherVersions(models)
    cell.manager.versions = versions  # type: ignore[assignment]
    cell.ends("one")
    assert (versions.asked, versions.learnt) == ([], [])


def test_an_insertion_whose_disk_fills_names_no_recording_and_is_no_evidence_for_a_version(
    cell: Cell, models: ModelSet
) -> None:
    versions = OtherVersions(models)
    cell.manager.versions = versions  # type: ignore[assignment]
    cell.client.connect("one")
    cell.manager.active.recorder.work_out("/beside", full, 0)  # type: ignore[union-attr]
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    late = Client(cell.manager)
    late.connect("one")
    (logged,) = [content for kind, content in cell.events if kind == "recorded"]
    assert [ended.recording for ended in (cell.client.heard[-1], late.heard[-1], logged)] == [None] * 3
    assert versions.learnt == []
    cell.ends("two", arm())
    assert [one for one, *_ in versions.learnt] == ["two"]


def test_an_insertion_with_a_value_that_cannot_be_recorded_names_its_recording_and_is_no_evidence_either(
    cell: Cell, models: ModelSet
) -> None:
    versions = OtherVersions(models)
    cell.manager.versions = versions  # type: ignore[assignment]
    cell.client.connect("one")
    cell.manager.active.recorder.work_out("/beside", lambda: {"chance": object()}, 0)  # type: ignore[union-attr]
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    finished: Any = cell.client.heard[-1]
    assert Path(finished.recording).is_file()
    assert versions.learnt == []


def test_a_share_that_fails_once_its_recording_is_closed_keeps_no_outcome_from_the_client(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell.client.connect("one")
    recorder: Any = cell.manager.active.recorder  # type: ignore[union-attr]
    asked = Path.stat

    def stat(path: Path, **options: Any) -> Any:
        if path == recorder.path:
            raise OSError(errno.EIO, "Input/output error")
        return asked(path, **options)

    monkeypatch.setattr(Path, "stat", stat)
    cell.manager.abort("operator", "done")
    wait_for_recorders()
    assert (cell.client.heard[-1].type, cell.client.heard[-1].recording) == ("finished", str(recorder.path))


def full() -> dict[str, Any]:
    raise OSError(errno.ENOSPC, "No space left on device")
