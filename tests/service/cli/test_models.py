"""`python -m service models` states in one line why the service would refuse a folder."""

import pytest

from service.__main__ import main
from tests.docs.commands import ROOT


def test_a_folder_without_models_is_one_line_and_exit_2(tmp_path, capsys):
    assert main(["models", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "no *.onnx model" in error
    assert len(error.strip().splitlines()) == 1


def test_the_released_models_are_described(capsys):
    if not list((ROOT / "models").glob("*.onnx")):  # a checkout in which none is released yet
        return
    assert main(["models", str(ROOT / "models")]) == 0
    out = capsys.readouterr().out
    assert out.count(", decides") in {1, 2}
    assert "sha256" in out


@pytest.mark.parametrize(
    ("folder", "takes"),
    [
        ("models", "8 fields of 20 x 21 markers, of both fingers,"),
        ("models/pictures", "8 frame pairs, 327 x 320 bgr,"),
        ("models/pressing", "8 steps of 0.15 mm on 13 x 13 points,"),
    ],
)
def test_a_model_is_said_to_take_what_it_reads(capsys, folder, takes):
    assert main(["models", str(ROOT / folder)]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  takes")]
    assert lines
    assert all(takes in line for line in lines)
