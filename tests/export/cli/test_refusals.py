import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from export.cli.commands import main
from export.onnx.verify import _bounded
from service.contract import ContractError


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


def test_an_export_without_a_folder_replaces_no_network(tmp_path, monkeypatch, capsys):
    """Where it was typed, ``models`` holds the released ones."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["export", "onnx", "models/pressing/checkpoint.pt"])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "--out" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("value", "named"), [(-2e4, "2e+04"), (np.nan, "nan")])
def test_an_output_that_is_too_large_is_refused_with_its_size_and_the_bound(value, named):
    with pytest.raises(ContractError) as refused:
        _bounded(SimpleNamespace(file=Path("a.onnx")), "noise", {"logits": np.array([0.0, value])})
    assert str(refused.value) == f"a.onnx: logits reaches {named} on the hard input 'noise', allowed 10000 and finite"
