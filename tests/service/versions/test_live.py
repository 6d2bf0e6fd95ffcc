"""A version in shadow on a running service: it answers the active version's attempts, and decides when it should."""

import json
from collections.abc import Iterator
from pathlib import Path

import httpx
import onnx
import pytest

from service.__main__ import main
from service.contract.token import keep_token
from service.decision.models import load_models
from service.recordings.reader import Recording
from service.versions.contest import Bet, Contest
from tests.service import tiny_models
from tests.service.client import Driver
from tests.service.conftest import LiveService, live_service
from tests.waiting import wait_for

SURE = Bet(taken_n=100, capital=(100.0,) * 4)


def write_shadow(folder: Path, **changes: object) -> Path:
    """The same networks again, but for their cards: another version with the same answers."""
    return tiny_models.write_models(folder, git_commit="1" * 40, **changes)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    folder = tmp_path_factory.mktemp("cell")
    with live_service(folder, tiny_models.write_models(folder / "models")) as service:
        yield service


def ask(cell: LiveService, method: str, path: str = "", **params: str) -> httpx.Response:
    return httpx.request(method, cell.url(f"/v1/versions{path}"), params=params, headers=cell.bearer)


def insert(cell: LiveService, name: str, *, blocked: bool = False) -> tuple[list[str], Path]:
    """An object that goes in, at the second attempt if it is ``blocked``: who decided, and the recording."""
    driver = Driver(cell, name)
    decided = [entry.sha256 for entry in driver.until("hello").models]
    if blocked:
        driver.attempt(1)
    finished = driver.insert(1 + blocked)
    assert finished.outcome == "inserted"
    driver.close()
    return decided, Path(finished.recording)


def regrasped(cell: LiveService) -> None:
    """A blocked attempt, a regrasp instead of the next one, and the object goes in."""
    first = Driver(cell, "turned")
    first.attempt(1)
    first.arms(2)
    first.gives_up("afresh", "turned")
    again = Driver(cell, "upright", continues="turned")
    assert again.insert(1).outcome == "inserted"
    again.close()


def hashes(folder: Path) -> list[str]:
    return [entry.sha256 for entry in load_models(folder).entries]


def serving(cell: LiveService) -> list[str]:
    """The networks that a request is answered by."""
    return [entry["sha256"] for entry in httpx.get(cell.url("/v1/models")).json()["models"]]


def surely(cell: LiveService, role: str) -> None:
    """Let the next insertion be the last one that is needed to show that a version should decide."""
    versions = cell.station.versions
    wiring = versions._now.wiring
    contest = Contest(score=SURE, covers=(SURE, SURE), misses=(SURE, SURE), slow=SURE)
    versions._now = versions._now._replace(wiring=wiring.with_one(role, wiring.beside[role], contest))


def test_both_answer_to_the_same_attempt_and_the_record_holds_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models = tiny_models.write_models(tmp_path / "models")
    with live_service(tmp_path, models) as cell:
        folders = [write_shadow(tmp_path / name) for name in ("same", "other")]
        onnx.save(tiny_models.step_model("magnitude", seed=9), str(folders[1] / "magnitude.step.onnx"))
        for folder in folders:
            ask(cell, "POST", "/shadow", folder=str(folder))
            ask(cell, "POST", "/promote") if folder is folders[0] else None
        same, other = (ask(cell, "GET").json()[role]["version"] for role in ("previous", "shadow"))
        decided, path = insert(cell, "both", blocked=True)
        assert decided == hashes(folders[0])
        (entry,) = Recording(path).of("/beside")
        messages = [entry.json()["message"] for entry in Recording(path).of("/messages")]
        correction = next(message for message in messages if message["type"] == "correction")
        answers = entry.json()["answers"]
        for key in ("dx_mm", "dtheta_deg", "estimate", "confidence"):
            assert answers[same][key] == correction[key]
        assert answers[other]["estimate"] != correction["estimate"]
        summary = json.loads((path.parent / "summary.json").read_text())
        assert summary["decisions"][0]["beside"] == answers
        wait_for(lambda: ask(cell, "GET").json()["shadow"]["scored_n"] == 1)
        assert ask(cell, "GET").json()["previous"]["scored_n"] == 1
        assert insert(cell, "twice")[0] == decided
        wait_for(lambda: ask(cell, "GET").json()["shadow"]["ended_n"] == 2)
        assert ask(cell, "GET").json()["shadow"]["scored_n"] == 1, "an insertion without a blocked attempt scores none"
        capsys.readouterr()
        assert main(["versions", "--url", cell.url("")]) == 0
        assert "of 20, after 2 insertions" in " ".join(capsys.readouterr().out.split())
        regrasped(cell)
        wait_for(lambda: cell.station.versions._now.wiring.contest("shadow").ended_n == 3)
        assert cell.station.versions._now.wiring.contest("shadow").attempts_n == 2 + 1 + 2, "of both grasps"
        where = cell.station.versions.active.steps[0].path.parent
        assert main(["replay", str(path), "--models", str(where)]) == 0  # bit for bit: nothing beside it moved the arm


@pytest.mark.slow
def test_the_better_one_decides_the_next_insertion_also_after_a_restart_and_a_worse_one_goes(tmp_path: Path) -> None:
    models, shadow = tiny_models.write_models(tmp_path / "models"), write_shadow(tmp_path / "shadow")
    with live_service(tmp_path, models, shadow=shadow) as cell:
        surely(cell, "shadow")
        assert insert(cell, "before")[0] == hashes(models)
        wait_for(lambda: ask(cell, "GET").json()["previous"])
        words = "decides from the next insertion on: it foretells better"
        wait_for(lambda: any(words in one["text"] for one in httpx.get(cell.url("/v1/status")).json()["events"]))
        assert insert(cell, "promoted")[0] == hashes(shadow)
        wait_for(lambda: ask(cell, "GET").json()["previous"]["ended_n"] == 1)
        page, state = httpx.get(cell.url("/v1/status")).json(), ask(cell, "GET").json()
        active, before = state["active"]["version"], state["previous"]["version"]
        assert page["health"]["versions"][0] == f"version {active[:6]} decides"
        assert page["health"]["versions"][1] == f"before {before[:6]}: 1.0 of 20 after 1"
        metrics = cell.metrics()
        assert f'tactile_version_evidence{{role="previous",version="{before}"}} ' in metrics
    with live_service(tmp_path, models, shadow=shadow) as cell:
        assert ask(cell, "GET").json()["previous"]["ended_n"] == 1
        surely(cell, "previous")
        assert insert(cell, "restarted")[0] == hashes(shadow)
        wait_for(lambda: ask(cell, "GET").json()["previous"] is None)
        assert insert(cell, "back")[0] == hashes(models)
        refused = ask(cell, "POST", "/shadow", folder=str(shadow))
        assert refused.status_code == 400
        assert "was rejected: " in refused.json()["error"]
        page = httpx.get(cell.url("/v1/status")).json()
        assert [alarm["title"] for alarm in page["alarms"]] == ["The networks of before decide again"]
        metrics = cell.metrics()
        assert 'tactile_version_changes_total{what="rolled_back"} 1.0' in metrics
        assert "tactile_version_evidence{" not in metrics
    with live_service(tmp_path, models, shadow=shadow) as cell:  # a rejected one in a setting stops no cell
        assert "was rejected: " in ask(cell, "GET").json()["problem"]
        health = httpx.get(cell.url("/v1/status")).json()["health"]
        assert health["versions"] == []
        assert health["versions_problem"].startswith(f"no shadow: {shadow} holds version ")
        assert cell.station.models.entries == load_models(models).entries


def test_a_person_changes_versions_between_insertions_and_never_in_one(
    cell: LiveService, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shadow, models = write_shadow(tmp_path / "shadow"), cell.station.settings.models
    there = ["--url", cell.url(""), "--token-file", str(cell.station.settings.state / "token")]
    assert main(["versions", "shadow", str(shadow), *there]) == 0
    assert "evidence 1.00 of 20" in capsys.readouterr().out
    driver = Driver(cell, "under-way")
    assert [entry.sha256 for entry in driver.until("hello").models] == hashes(models)
    assert main(["versions", "promote", *there]) == 0
    assert [entry.sha256 for entry in cell.station.active.session.models.entries] == serving(cell) == hashes(models)
    assert driver.insert(1).outcome == "inserted"
    driver.close()
    wait_for(lambda: cell.station.active is None)
    assert serving(cell) == hashes(shadow), "what is asked about recorded frames is asked of those that decide next"
    assert insert(cell, "next")[0] == hashes(shadow)
    assert main(["versions", "rollback", *there]) == 0
    assert insert(cell, "last")[0] == hashes(models)
    assert not httpx.get(cell.url("/v1/status")).json()["alarms"], "who went back knows of it, and why"
    for words in (["promote"], ["rollback"], ["drop"], ["shadow", str(tmp_path / "none")]):
        assert main(["versions", *words, *there]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_networks_that_only_guess_are_named_to_whoever_puts_them_in_shadow_or_lets_them_decide(
    cell: LiveService, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    there = ["--url", cell.url(""), "--token-file", str(cell.station.settings.state / "token")]
    guessing = write_shadow(tmp_path / "guessing", training_run={"untrained": "12 % are right"})
    caution = "caution: tiny-direction is untrained: 12 % are right"
    for words in (["shadow", str(guessing)], ["promote"], ["show"]):
        assert main(["versions", *words, *there]) == 0
        assert caution in capsys.readouterr().out
    assert main(["versions", "rollback", *there]) == 0
    assert caution not in capsys.readouterr().out


def test_a_token_for_watching_shows_the_versions_where_watching_needs_one(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with live_service(tmp_path, models_folder, token_watch="a-token-for-watching") as guarded:
        (tmp_path / "token").write_text("a-token-for-watching\n")
        assert main(["versions", "--url", guarded.url("")]) == 2
        assert "a bearer token is needed" in capsys.readouterr().err
        assert main(["versions", "--url", guarded.url(""), "--token-file", str(tmp_path / "token")]) == 0
        assert guarded.station.versions.state().active.version in capsys.readouterr().out


def test_the_token_of_this_machine_is_not_sent_to_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    keep_token(tmp_path)
    monkeypatch.setenv("TACTILE_STATE", str(tmp_path))
    monkeypatch.setattr(httpx, "request", lambda *_, **__: pytest.fail("something was sent"))
    assert main(["versions", "promote", "--url", "http://192.0.2.1:8000"]) == 2
    assert "this machine's token is not sent elsewhere" in capsys.readouterr().err


def test_no_proxy_of_the_environment_gets_the_token(cell: LiveService, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    monkeypatch.setenv("no_proxy", "")
    assert main(["versions", "--url", cell.url("")]) == 0


def test_networks_that_cannot_be_compared_are_refused_in_one_line(cell: LiveService, tmp_path: Path) -> None:
    shorter, models = write_shadow(tmp_path / "shorter", frames_per_decision=6), cell.station.settings.models
    for folder, why in ((shorter, "frames_per_decision"), (models, "decides now"), (tmp_path, "no *.onnx")):
        refused = ask(cell, "POST", "/shadow", folder=str(folder))
        assert refused.status_code == 400
        assert why in refused.json()["error"]
        assert "\n" not in refused.json()["error"]


def test_versions_that_cannot_be_kept_change_nothing_and_the_refusal_names_the_folder_and_the_reason(
    tmp_path: Path, models_folder: Path
) -> None:
    with live_service(tmp_path, models_folder) as cell:
        (tmp_path / "state" / "versions").write_text("a file where the folder belongs")
        refused = ask(cell, "POST", "/shadow", folder=str(write_shadow(tmp_path / "shadow")))
        assert refused.status_code == 400
        why = f"File exists: {tmp_path / 'state' / 'versions'}"
        assert refused.json()["error"] == f"versions in {tmp_path / 'state'}: {why}"
        assert ask(cell, "GET").json()["shadow"] is None
