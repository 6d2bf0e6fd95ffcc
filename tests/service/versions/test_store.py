"""The wiring on disk survives a kill at any moment, and an edited one is refused."""

import contextlib
import errno
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import structlog

from service.contract import ContractError
from service.decision.models import load_models
from service.session.state_machine import DEFAULT_LIMITS
from service.versions.store import WIRING, Store, Wiring, version_of
from service.versions.versions import Versions
from tests.service import tiny_models

ENDLESS = """
import sys
from pathlib import Path
from service.decision.models import load_models
from service.versions.versions import Versions
home, released, *shadows = map(Path, sys.argv[1:])
versions = Versions(home, load_models(released), lambda *_: None)
while True:
    for shadow in shadows:
        try:
            versions.give(shadow)
        except ValueError:
            pass
        else:
            versions.promote()
            print("promoted", flush=True)
"""


ROLES = ("direction", "magnitude")


def quiet(_: str, __: object) -> None:
    """A listener that does nothing."""


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    return [tiny_models.write_models(tmp_path / name, git_commit=name * 40) for name in "abc"]


def test_a_kill_in_mid_promotion_leaves_the_version_before_or_the_one_after(tmp_path: Path, three: list[Path]) -> None:
    home, names = tmp_path / "versions", {version_of(load_models(folder)) for folder in three}
    for wait_s in (0.002, 0.01, 0.04):
        command = [sys.executable, "-c", ENDLESS, str(home), str(three[0]), *map(str, three)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            watchdog = threading.Timer(60.0, process.kill)
            watchdog.start()
            promoted_once = process.stdout.readline()
            time.sleep(wait_s)
            os.kill(process.pid, signal.SIGKILL)
            watchdog.cancel()
        assert promoted_once == b"promoted\n"
        opened = Versions(home, load_models(three[0]), quiet)
        state = opened.state()
        assert version_of(opened.active) == state.active.version in names
        assert state.problem == ""
        assert state.previous.version in names - {state.active.version}
        opened.close()


def promoted(home: Path, three: list[Path]) -> Versions:
    versions = Versions(home, load_models(three[0]), quiet)
    versions.give(three[1])
    versions.promote()
    return versions


def test_an_edited_wiring_and_an_exchanged_version_are_refused(tmp_path: Path, three: list[Path]) -> None:
    home = tmp_path / "versions"
    versions = promoted(home, three)
    active = versions.state().active.version
    versions.close()
    text = (home / WIRING).read_text()
    for wrong in (text.replace(active, "0" * 16), "{", text.replace('"schema_version": 1', '"schema_version": 2')):
        (home / WIRING).write_text(wrong)
        with pytest.raises(ContractError, match=r"remove it to begin anew"):
            Versions(home, load_models(three[0]), quiet)
    (home / WIRING).write_text(text)
    for path in (home / active).iterdir():
        path.write_bytes((three[2] / path.name).read_bytes())
    with pytest.raises(ContractError, match=r"does not hold version .*; remove .*wiring.json to begin anew"):
        Versions(home, load_models(three[0]), quiet)
    shutil.rmtree(home / active)
    with pytest.raises(ContractError, match=r"remove .*wiring.json to begin anew"):
        Versions(home, load_models(three[0]), quiet)


def test_the_wiring_of_an_earlier_release_counted_no_objects_and_is_read(tmp_path: Path) -> None:
    bet = '{"taken_n":0,"capital":[0.0,0.0,0.0,0.0]}'
    bets = f'"score":{bet},"covers":[{bet},{bet}],"misses":[{bet},{bet}],"slow":{bet}'
    contest = f'{{"scored_n":0,"ended_n":3,"attempts_n":7,"tolerated":1.96,{bets}}}'
    roles = f'"beside":{{"previous":"a"}},"contests":{{"previous":{contest}}},"rejected":{{}}'
    digest = "69961a9ae0dccfacf3656d401f603919580ba6f848a5e882fed50d81bf37b9ea"
    (tmp_path / WIRING).write_text(f'{{"schema_version":1,"released":"a","active":"b",{roles},"sha256":"{digest}"}}')
    with contextlib.closing(Store(tmp_path)) as store:
        read = store.open()
        assert read is not None
        assert read.contest("previous").attempts_n == 7
        assert read.contest("previous").ended(4, "box").slow.worth < 1.0, "what the box took before is not known"
        store.wire(read)
        assert store.open() == read.model_copy(update={"sha256": read.digest()})
        text = (tmp_path / WIRING).read_text()
        (tmp_path / WIRING).write_text(text.replace('"attempts_n": 7', '"attempts_n": 8'))
        with pytest.raises(ContractError, match="is not as it was written"):
            store.open()


def test_a_lost_version_beside_is_left_out_and_the_active_one_goes_on(tmp_path: Path, three: list[Path]) -> None:
    home = tmp_path / "versions"
    versions = promoted(home, three)
    versions.give(three[2])
    active, shadow = versions.state().active.version, versions.state().shadow.version
    versions.close()
    for path in (home / shadow).iterdir():
        path.unlink()
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        assert opened.state().active.version == active
        assert opened.state().shadow is None
        assert "left out" in opened.state().problem


def test_another_release_begins_anew(tmp_path: Path, three: list[Path]) -> None:
    promoted(tmp_path / "versions", three).close()
    with contextlib.closing(Versions(tmp_path / "versions", load_models(three[2]), quiet)) as opened:
        assert opened.state().active.version == version_of(load_models(three[2]))
        assert opened.state().previous is None


@pytest.mark.parametrize("what", ["incomparable", "gone", "no room"])
def test_a_shadow_of_the_settings_that_cannot_run_is_a_problem_and_stops_no_cell(
    tmp_path: Path, three: list[Path], what: str
) -> None:
    older, home = tmp_path / "older", tmp_path / "versions"
    if what != "gone":
        tiny_models.write_models(older, frames_per_decision=6 if what == "incomparable" else 8)
    if what == "no room":
        home.touch()
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        opened.give(older, at_start=True)
        assert opened.state().shadow is None
        expected = {"incomparable": "cannot run in shadow: frames_per_decision", "gone": "no *.onnx model in"}
        assert expected.get(what, "versions") in opened.state().problem
        with pytest.raises((ContractError, OSError)):
            opened.give(older)
        home.unlink() if what == "no room" else None
        opened.give(three[1])
        assert opened.state().problem == "", "a shadow runs"
        shutil.rmtree(three[1])
        opened.give(three[1], at_start=True)
        assert opened.state().problem == "", "its copy does"


def restarted(home: Path, three: list[Path], shadow: Path) -> tuple[str | None, str | None]:
    """Who runs in shadow after a start whose settings name one, and who decided before."""
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        opened.give(shadow, at_start=True)
        state = opened.state()
        assert state.problem == ""
        return state.shadow and state.shadow.version, state.previous and state.previous.version


@pytest.mark.parametrize("already", [False, True])
def test_what_is_changed_by_hand_outlives_every_start_with_the_same_setting(
    tmp_path: Path, three: list[Path], already: bool
) -> None:
    """``already``: the version ran in shadow already when the settings first named it."""
    home, (_, first, second) = tmp_path / "versions", (version_of(load_models(folder)) for folder in three)
    if already:
        with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
            opened.give(three[1])
    assert restarted(home, three, three[1]) == (first, None)
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        opened.drop()
    assert restarted(home, three, three[1]) == (None, None)
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        opened.give(three[2])
        wiring = opened._now.wiring
        opened._wire(wiring.with_one("shadow", second, wiring.contest("shadow").ended(2, "box")))
    assert restarted(home, three, three[1]) == (second, None)
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        assert opened.state().shadow.ended_n == 1, "its evidence counts on"
        opened.promote()
    assert restarted(home, three, three[1]) == (None, version_of(load_models(three[0])))
    with contextlib.closing(Versions(home, load_models(three[0]), quiet)) as opened:
        opened.give(three[1])
        opened.drop()
    changed = tiny_models.write_models(tmp_path / "changed", git_commit="d" * 40)
    assert restarted(home, three, changed)[0] == version_of(load_models(changed)), "another setting is another request"


def test_a_shadow_of_the_settings_that_was_lost_is_given_again(tmp_path: Path, three: list[Path]) -> None:
    home = tmp_path / "versions"
    shadow, _ = restarted(home, three, three[1])
    shutil.rmtree(home / shadow)
    assert restarted(home, three, three[1])[0] == shadow


def test_a_release_that_has_no_part_any_more_answers_nothing(tmp_path: Path, three: list[Path]) -> None:
    with contextlib.closing(promoted(tmp_path / "versions", three)) as opened:
        opened.give(three[2])
        opened.promote()
        beside = opened.beside(opened.active, DEFAULT_LIMITS, "belief")
        assert set(beside.networks) == {version_of(load_models(folder)) for folder in three[1:]}


def test_a_shadow_that_is_refused_by_hand_leaves_no_problem_behind(tmp_path: Path, three: list[Path]) -> None:
    with contextlib.closing(promoted(tmp_path / "versions", three)) as opened:
        opened.roll_back()
        opened.give(three[2])
        with pytest.raises(ContractError, match="which was rejected"):
            opened.give(three[1])
        assert opened.state().shadow.version == version_of(load_models(three[2]))
        assert opened.state().problem == ""


def test_the_log_has_a_line_for_networks_that_only_guess_whether_they_decide_or_run_in_shadow(
    tmp_path: Path, three: list[Path]
) -> None:
    guessing = tiny_models.write_models(tmp_path / "guessing", training_run={"untrained": "12 % are right"})
    with structlog.testing.capture_logs() as lines:
        Versions(tmp_path / "versions", load_models(guessing), quiet).close()
    assert [line["caution"] for line in lines] == [f"tiny-{one} is untrained: 12 % are right" for one in ROLES]
    sound = Versions(tmp_path / "other", load_models(three[0]), quiet)
    with structlog.testing.capture_logs() as lines, contextlib.closing(sound):
        sound.give(guessing)
    assert {line["version"] for line in lines} == {version_of(load_models(guessing))}
    with structlog.testing.capture_logs() as restarted:
        Versions(tmp_path / "other", load_models(three[0]), quiet).close()
    assert restarted == [line for line in lines if "caution" in line]


def test_networks_that_were_rolled_back_stay_until_the_next_rollback_and_the_event_says_where(
    tmp_path: Path, three: list[Path]
) -> None:
    home, events = tmp_path / "versions", list[dict[str, str]]()
    versions = Versions(home, load_models(three[0]), lambda _, event: events.append(event))
    first, second = (version_of(load_models(folder)) for folder in three[1:])
    with contextlib.closing(versions):
        versions.give(three[1])
        versions.promote()
        versions.roll_back()
        assert version_of(load_models(home / first)) == first
        assert events[-1]["why"] == f"by hand; its networks stay in {home / first} until the next rollback"
        assert versions.state().rejected == {first: "by hand"}
        versions.give(three[2])
        versions.promote()
        assert (home / first).is_dir()
        versions.roll_back()
        assert not (home / first).exists()
        assert version_of(load_models(home / second)) == second


def test_two_services_do_not_share_their_versions(tmp_path: Path, three: list[Path]) -> None:
    first = promoted(tmp_path / "versions", three)
    with pytest.raises(ContractError, match="give each its own --state"):
        Versions(tmp_path / "versions", load_models(three[0]), quiet)
    first.close()
    Versions(tmp_path / "versions", load_models(three[0]), quiet).close()


def test_a_version_that_a_kill_left_half_removed_is_kept_again(tmp_path: Path, three: list[Path]) -> None:
    store, models = Store(tmp_path / "versions"), load_models(three[1])
    with contextlib.closing(store):
        version = store.keep(models)
        (tmp_path / "versions" / version / "direction.step.onnx").unlink()
        assert store.keep(models) == version
        assert version_of(store.load(version)) == version


def test_a_disk_that_keeps_no_locks_is_not_taken_for_another_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unlocked(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", unlocked)
    with pytest.raises(OSError, match="No locks available"):
        Store(tmp_path / "versions").wire(Wiring(released="a", active="a"))
