import sys

import pytest

from export.cli.commands import main


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("verify models --stream-steps -1", "--stream-steps -1"),
        ("benchmark --seconds nan", "--seconds nan"),
        ("benchmark --seconds -1", "--seconds -1"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once_by_name(command, named, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["export", *command.split()])
    assert main() == 2
    assert named in capsys.readouterr().err
