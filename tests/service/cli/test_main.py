import pytest

from service import __main__ as entry


def test_unknown_command_is_one_line_and_exit_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["dance"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "allowed: calibrate, judge, models, replay, run" in error


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in entry.COMMANDS)
