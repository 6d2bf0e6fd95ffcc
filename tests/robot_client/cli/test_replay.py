"""The log of an insertion: it replays, it is never overwritten, and an invalid file gives one clear line."""

import json
from datetime import UTC, datetime, timedelta

import pytest

from robot_client.__main__ import main
from robot_client.session.recorder import LOG_VERSION, read_log
from robot_client.session.replay import ReplayError, replay
from service import __version__
from service.contract import ContractError


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory):
    log = tmp_path_factory.mktemp("log") / "episode.jsonl"
    assert main(["insert", "--x-mm", "8", "--theta-deg", "6", "--log", str(log)]) == 0
    return log


def test_a_rehearsal_inserts_and_replays(rehearsed, capsys):
    assert main(["replay", str(rehearsed)]) == 0
    out = capsys.readouterr().out
    assert "INSERTED after 3 attempts" in out


def test_a_log_begins_with_its_release_and_its_time(rehearsed):
    first = json.loads(rehearsed.read_text().splitlines()[0])
    assert first["release"] == __version__
    assert abs(datetime.fromisoformat(first["begun"]) - datetime.now(UTC)) < timedelta(hours=1)


def test_a_log_is_never_overwritten(rehearsed, capsys):
    assert main(["insert", "--log", str(rehearsed)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_changed_log_does_not_replay(rehearsed, tmp_path):
    lines = rehearsed.read_text().splitlines()
    index = next(i for i, line in enumerate(lines) if '"motion": "retract"' in line)
    changed = json.loads(lines[index])
    changed["command"]["target"]["x_mm"] += 0.001
    path = tmp_path / "changed.jsonl"
    path.write_text("\n".join([*lines[:index], json.dumps(changed), *lines[index + 1 :]]))
    with pytest.raises(ReplayError, match=f"line {index + 1}"):
        replay(path, show=lambda _line: None)
    assert main(["replay", str(path)]) == 1


def test_a_log_that_was_cut_in_the_middle_of_a_line_still_reads(rehearsed, tmp_path):
    path = tmp_path / "cut.jsonl"
    path.write_text(rehearsed.read_text()[:-200])
    plan, entries, end = read_log(path)
    assert plan.gap_width_mm == 56.0
    assert entries
    assert end == {}


@pytest.mark.parametrize(
    ("version", "named"),
    [
        (LOG_VERSION - 1, f"version {LOG_VERSION - 1}"),
        (LOG_VERSION + 1, f"version {LOG_VERSION + 1}"),
        ("2", "version '2'"),
    ],
)
def test_a_log_of_another_version_is_refused_as_that(version, named, rehearsed, tmp_path):
    """Also where its plan could not be read any more."""
    first, *others = rehearsed.read_text().splitlines()
    for plan in (json.loads(first)["plan"], {"from": "another version"}):
        path = tmp_path / "other.jsonl"
        path.write_text("\n".join([json.dumps({"version": version, "plan": plan}), *others]))
        with pytest.raises(ContractError, match=f"is an episode log of {named}, expected {LOG_VERSION}"):
            read_log(path)
    path.write_text("\n".join([json.dumps({"version": version, "release": "0.1.7", "plan": plan}), *others]))
    with pytest.raises(ContractError, match=r": replay it with release 0\.1\.7, which wrote it$"):
        read_log(path)
    path.write_text("\n".join([json.dumps({"plan": plan}), *others]))
    with pytest.raises(ContractError, match=f"of version None, expected {LOG_VERSION}"):
        read_log(path)


@pytest.mark.parametrize("end", ["3", "[]", '{"phase": "inserted", "link": 3}'])
def test_an_end_that_is_none_is_no_traceback(end, rehearsed, tmp_path, capsys):
    path = tmp_path / "end.jsonl"
    path.write_text("\n".join([*rehearsed.read_text().splitlines()[:-1], f'{{"end": {end}}}']))
    assert main(["replay", str(path)]) in {0, 2}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "nonsense\nmore\n",
        "[1]\n{}\n",
        '{"event": {"kind": "begin"}}\n{}\n',
        '{"end": 3}\n',
        "[" * 100_000 + "\n{}\n",
    ],
)
def test_a_file_that_is_no_log_is_refused_in_one_line(text, tmp_path):
    path = tmp_path / "x.jsonl"
    path.write_text(text)
    with pytest.raises(ContractError):
        read_log(path)
