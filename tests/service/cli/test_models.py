"""`python -m service models` states in one line why the service would refuse a folder."""

import onnx
import pytest

from service.__main__ import main
from tests.docs.commands import ROOT
from tests.service import tiny_models


def test_a_folder_without_models_is_one_line_and_exit_2(tmp_path, capsys):
    assert main(["models", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert "no *.onnx model" in error
    assert len(error.strip().splitlines()) == 1


def test_networks_of_different_trainings_are_named(tmp_path, capsys):
    folder = tiny_models.write_models(tmp_path)
    assert main(["models", str(folder)]) == 0
    assert "caution" not in capsys.readouterr().out
    onnx.save(tiny_models.step_model("magnitude", training_run={"seed": 2}), str(folder / "magnitude.step.onnx"))
    assert main(["models", str(folder)]) == 0
    caution = "caution: tiny-direction and tiny-magnitude are from different trainings"
    assert caution in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("folder", "takes"),
    [
        ("models", "8 fields of 20 x 21 markers, of both fingers,"),
        ("models/pictures", "8 frame pairs, 327 x 320 bgr,"),
        ("models/pressing", "8 steps of 0.15 mm on 13 x 13 points,"),
    ],
)
def test_a_released_model_is_described_and_said_to_take_what_it_reads(capsys, folder, takes):
    assert main(["models", str(ROOT / folder)]) == 0
    out = capsys.readouterr().out
    assert " ".join(out.split()).count(", decides") in {1, 2}
    assert "sha256" in out
    lines = [line for line in out.splitlines() if line.startswith("  takes")]
    assert lines
    assert all(takes in line for line in lines)
