"""CalculiX gets the foreign cell's own pad and path, and its output is read correctly."""

import json
from pathlib import Path

import numpy as np
import pytest

from simulation.cli import physics
from simulation.foreign.elements import Pad
from simulation.studies.witness import calculix, check

PAD = Pad(22.0, 20.0, 2.5, 0.48, (1.0, 0.0), columns=4, rows=4, layers=1)


@pytest.mark.parametrize("side", [1, -1])
def test_bricks_are_turned_outside_out_and_slaves_cover_the_face(side):
    mesh = calculix.Mesh(PAD, side, (4, 2, 4))
    place = dict(zip(mesh.ids.tolist(), mesh.places, strict=True))
    corners = np.array([[place[node] for node in brick[:8]] for brick in mesh.bricks])
    along = [corners[:, to] - corners[:, 0] for to in (1, 3, 4)]
    volumes = np.einsum("ij,ij->i", np.cross(along[0], along[1]), along[2])
    assert volumes.min() > 0.0
    assert volumes.sum() == pytest.approx(24.0 * 20.0 * 2.5)
    assert len(mesh.slaves) == 16
    face = {1: [0, 1, 5, 4], -1: [2, 3, 7, 6]}[side]
    assert np.abs(corners[mesh.slaves - 1][:, face, 1]).max() == 0.0


@pytest.mark.parametrize("side", [1, -1])
def test_the_plate_turns_its_crest_to_the_pad(side):
    corners = calculix.plate_at(np.eye(3), np.zeros(3), 40.0, side)
    assert corners[check.CORNER_ROWS[side], 1] == pytest.approx(40.0 * side)
    assert side * np.delete(corners[:, 1], check.CORNER_ROWS[side]).max() < 40.0


def test_columns_that_touch_are_read_apart(tmp_path):
    written = (
        " -4  CONTACT     6    1\n -1       123" + "-1.00000E+00" * 3 + " 4.00000E-02-3.00000E-02 1.00000E-02\n -3\n"
    )
    assert calculix._contact(written) == {123: (0.04, -0.03, 0.01)}


def test_without_calculix_nothing_is_done_and_nothing_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(calculix.shutil, "which", lambda _: None)
    assert physics.foreign_check(["--out", str(tmp_path)]) == 0
    assert "skipped, there is no ccx" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_published_forces_agree_but_where_the_page_says_not():
    data = json.loads((Path("docs") / "foreign_check.json").read_text())
    answered = [row for row in data["probes"] if "failed" not in row and row["kind"] != "pressing, plate askew"]
    assert len(answered) >= 14
    assert max(row["normal_apart"] for row in answered) <= 0.03
    held = [row for row in answered if max(row["slip"]) < 0.5]
    assert len(held) >= 12
    assert max(row["shear_apart"] for row in held) <= 0.03
    assert max(row["shear_apart"] for row in answered) <= 0.035  # most of the contact slides
    assert max(row["moved_apart_inside"] for row in answered) <= 0.05


@pytest.mark.slow
@pytest.mark.skipif(not calculix.is_installed(), reason="no ccx here to ask")
def test_a_pressed_pad_answers_as_calculix_says():
    row = check.compared(check.PROBES[0])
    assert row["normal_apart"] < 0.03
    assert row["moved_apart"] < 0.05
