import pytest

from service import __main__ as entry


def test_unknown_command_is_one_line_and_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["dance"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "expected one of run" in error


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in entry.COMMANDS)


def test_replay_of_a_recorded_insertion_is_a_re_decision() -> None:
    assert entry.module_of("replay", ["a/b.mcap"]) == "service.tools.redecide"
    assert entry.module_of("replay", ["clip.avi", "--out", "x"]) == "service.tools.replay"
