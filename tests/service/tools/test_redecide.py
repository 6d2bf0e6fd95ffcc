"""A recording may come from anybody: no path in it is opened."""

import json
import shutil
from pathlib import Path
from typing import Any

import onnx
import pytest
from websockets.sync.client import connect

from service.__main__ import main
from service.contract import wire
from service.decision import models as models_module
from service.recordings.reader import Recording
from service.recordings.writer import Recorder
from service.session.factory import make_session
from service.settings import Settings
from service.tools.redecide import differences, open_replay
from tests.service import tiny_models
from tests.service.client import greeted
from tests.service.conftest import LiveService, bearer, served


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Every network that is opened from now on."""
    paths: list[Path] = []
    load = models_module.load_model
    monkeypatch.setattr(models_module, "load_model", lambda path: paths.append(path) or load(path))
    return paths


def recording(
    folder: Path, models: Path, hashes: list[str], configuration: bytes | None = None, ticked_ns: int | None = None
) -> Path:
    facts = {"models": " ".join(f"tiny:{h}" for h in hashes), "models_folder": str(models), "calibration": ""}
    limits = '{"max_dx_mm": 15.0, "max_dtheta_deg": 15.0, "max_frame_age_ms": 150.0}'
    attached = {"configuration.json": configuration} if configuration else {}
    recorder = Recorder(folder, "foreign", facts | {"controller": "belief", "limits": limits}, attachments=attached)
    if ticked_ns:
        recorder.call({"call": "tick"}, ticked_ns)
    return recorder.close({"outcome": "aborted", "attempts": 0})


def hashes_of(folder: Path) -> list[str]:
    return [entry.sha256 for entry in models_module.load_models(folder).entries]


def test_the_models_that_a_recording_names_are_not_opened(
    tmp_path: Path, models_folder: Path, opened: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = shutil.copytree(models_folder, tmp_path / "theirs")
    onnx.save(tiny_models.step_model("direction", seed=5), str(theirs / "direction.step.onnx"))
    path = recording(tmp_path / "r", theirs, hashes_of(theirs))
    opened.clear()
    assert main(["replay", str(path)]) == 2
    assert main(["replay", str(path), "--models", str(models_folder)]) == 2
    assert opened == []
    printed = capsys.readouterr().err
    assert "was decided by other models than those of" in printed
    assert f"they lay in {theirs}; where you trust them, name it with --models" in printed


def test_models_that_the_user_trusts_are_opened_once_their_hashes_are_the_recorded_ones(
    tmp_path: Path, models_folder: Path, opened: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path / "r", tmp_path / "nowhere", hashes_of(models_folder))
    opened.clear()
    assert main(["replay", str(path), "--models", str(models_folder), "--json"]) == 0
    assert opened
    assert json.loads(capsys.readouterr().out) == {"same": True, "messages_n": 0, "differing": []}


def test_a_recording_of_another_version_is_refused_by_what_it_lacks(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Recorder(tmp_path, "old", {"models": "", "limits": "{}"}).close({"outcome": "inserted", "attempts": 1})
    assert main(["replay", str(path), "--models", str(models_folder)]) == 2
    assert "lacks calibration, controller in its metadata" in capsys.readouterr().err


def test_a_recording_that_is_cut_off_or_damaged_is_never_called_the_same(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path / "r", Path(), hashes_of(models_folder), ticked_ns=1234567)
    whole, again = path.read_bytes(), ["replay", str(path), "--models", str(models_folder)]
    assert main(again) == 0
    capsys.readouterr()
    flipped = whole.replace(b"1234567", b"1234667")
    assert flipped != whole
    for content in (whole[:-20], flipped):
        path.write_bytes(content)
        assert main(again) == 1
        assert capsys.readouterr().out.startswith("the file ends early or is damaged, behind message 0: ")


def test_a_folder_of_models_is_told_as_json(models_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["models", str(models_folder), "--json"]) == 0
    models = json.loads(capsys.readouterr().out)
    assert sorted(one["sha256"] for one in models) == sorted(hashes_of(models_folder))
    assert {one["card"]["role"] for one in models if one["decides"]} == {"direction", "magnitude"}


@pytest.mark.slow
def test_an_insertion_that_went_on_with_an_object_taken_afresh_is_decided_again_with_what_was_known(
    live: LiveService, tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, before in (("first", None), ("second", "first")):
        path = Path(greeted(live, name, continues=before).after(1).gives_up("afresh", "turned_in_hand").recording)
    assert main(["replay", str(path), "--models", str(models_folder)]) == 0
    capsys.readouterr()
    alone = shutil.copytree(path.parent, tmp_path / path.parent.name)
    assert main(["replay", str(alone / path.name), "--models", str(models_folder)]) == 2
    assert "goes on with insertion first: expected its recording beside" in capsys.readouterr().err


def test_only_times_and_the_name_of_the_file_may_differ_from_the_recorded_message() -> None:
    then = {"type": "finished", "outcome": "aborted", "cause": "operator", "attempts": 1, "recording": "there"}
    assert differences([then], [then | {"recording": "here"}]) == []
    for other in ({"outcome": "failed"}, {"attempts": 2}, {"cause": "link"}):
        assert differences([then], [then | other]) != []


@pytest.mark.parametrize("named", [[], ["0" * 64]])
def test_a_recording_that_names_no_network_of_ours_opens_none(
    tmp_path: Path, models_folder: Path, opened: list[Path], named: list[str]
) -> None:
    assert main(["replay", str(recording(tmp_path / "r", models_folder, named)), "--models", str(models_folder)]) == 2
    assert opened == []


def test_a_recordings_text_reaches_the_terminal_as_text(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recording(tmp_path / "r", Path("/x\x1b[2J\x1b]0;owned\x07"), ["0" * 64])
    assert main(["replay", str(path), "--models", str(models_folder)]) == 2
    printed = capsys.readouterr().err
    assert "\\x1b[2J" in printed
    assert printed.replace("\n", "").isprintable()


@pytest.mark.parametrize("set_for_the_service", [{"reference_timeout_s": 0.2}, {"imprint_slip": False}])
def test_an_insertion_is_decided_again_with_the_settings_that_it_was_decided_with(
    tmp_path: Path, models_folder: Path, set_for_the_service: dict[str, Any]
) -> None:
    options = {"models": models_folder, "recordings": tmp_path / "r", "state": tmp_path / "state"}
    cameras = {"camera_left": "push:", "camera_right": "push:"}
    with served(Settings(**options, **cameras, **set_for_the_service)) as (station, port):
        head, url = bearer(station), f"ws://127.0.0.1:{port}/v1/insertion"
        with connect(url, additional_headers=head, compression=None) as link:
            link.send(wire.ClientHello(insertion_id="set", client="test").model_dump_json())
            link.send(
                wire.Arm(insertion_id="set", attempt=1, gap_width_mm=56.0, expected_depth_mm=25.0).model_dump_json()
            )
            assert [wire.parse_service(link.recv(20)).type for _ in range(2)] == ["hello", "refused"]
            link.send(wire.Abort(insertion_id="set", cause="refused", reason="no frames").model_dump_json())
            path = wire.parse_service(link.recv(20)).recording
        live = make_session(station.models, imprint=station.settings.imprint_slip)
    assert main(["replay", path, "--models", str(models_folder)]) == 0
    again = open_replay(Recording(Path(path)), models_module.load_models(models_folder)).session
    assert (again.left._imprint is None) == (live.left._imprint is None)


def test_settings_that_are_none_are_refused_in_one_line(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for content in (b"[]", b"{", b'{"frames_timeout_s": "soon"}'):
        path = recording(tmp_path, Path(), hashes_of(models_folder), content)
        assert main(["replay", str(path), "--models", str(models_folder)]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
