"""Rows of judged recordings are counted against labels: a late loss and a late alarm do not count, a false one does."""

import json

import pytest

from simulation.__main__ import main
from simulation.studies.slip.grasps import figures

LABELS = {
    "slip": {
        "box_1_slip": {"contact": 13, "slide": 40, "lost": 60},
        "box_2_slip": {"contact": 13, "slide": 40, "lost": 60},
        "box_3_slip": {"contact": 13, "slide": None, "lost": 60},
    },
    "held": {"box_5_hold": {"slide": None, "emptied": 90}},
}


def row(run, slip=None, lost=None, opened=13):
    frames = {"contact_frame": 20, "hold_frame": 30, "slip_frame": slip, "lost_frame": lost}
    return {"run": run, "frames_n": 130, **frames, "open_frame": opened, "ms_a_frame": 2.0}


def rows():
    return [
        row("box_1_slip", slip=50, lost=62),
        row("box_2_slip", slip=58, lost=70),
        row("box_3_slip", lost=61),
        row("box_4_hold", slip=80),
        row("box_5_hold", lost=91),
        row("box_6_hold", opened=None),
    ]


def test_only_what_is_told_in_time_counts():
    found = figures(rows(), LABELS)
    counted = {name: (found[name]["hits"], found[name]["runs"]) for name in ("lost", "warned", "slip_of_held")}
    assert counted == {"lost": (2, 3), "warned": (1, 2), "slip_of_held": (1, 3)}
    assert (found["lost_of_held"]["hits"], found["lost_of_held_to_the_end"]["hits"]) == (1, 0)
    assert found["lead_s"] == [1.25]
    assert found["without_open_frame"] == 1
    assert found["slip_per_1000"] == pytest.approx(1000 / (100 + 61 + 100))


def test_the_page_is_written_from_rows_and_labels_and_refuses_a_part(tmp_path, capsys):
    (tmp_path / "rows.json").write_text(json.dumps(rows()))
    (tmp_path / "labels.json").write_text(json.dumps(LABELS))
    given = ["--labels", str(tmp_path / "labels.json"), "--out", str(tmp_path)]
    assert main(["grasps", "--rows", str(tmp_path / "rows.json"), *given]) == 0
    assert "| box_2_slip | 40 | 60 | 20 | 30 | 58 | 70 |" in (tmp_path / "real_grasps.md").read_text()
    (tmp_path / "rows.json").write_text(json.dumps(rows()[1:]))
    assert main(["grasps", "--rows", str(tmp_path / "rows.json"), *given]) == 2
    assert "no rows of box_1_slip" in capsys.readouterr().err
