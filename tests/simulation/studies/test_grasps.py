"""Rows of judged recordings are counted against labels: a late loss and a late alarm do not count, a false one does."""

import json

import numpy as np
import pytest

from simulation.__main__ import main
from simulation.studies.slip.alarms import occasion, share
from simulation.studies.slip.grasps import figures

LABELS = {
    "slip": {
        "box_1_slip": {"contact": 13, "slide": 40, "lost": 60},
        "box_2_slip": {"contact": 13, "slide": 40, "lost": 60},
        "box_3_slip": {"contact": 13, "slide": None, "lost": 60},
        "can_7_slip": {"contact": 13, "slide": 40, "lost": 60},
    },
    "held": {"box_5_hold": {"slide": None, "emptied": 90}},
    "set_down": {"tin_4_hold": 75},
}


def live(armed=range(32, 130), **causes):
    """What a session would do: the frames in which it is armed, and those in which it stops, by cause."""
    frames = {f"{cause}_frames": [*causes.get(cause, ())] for cause in ("markers", "stalled", "imprint", "other")}
    parts = {"rectify": 0.3, "markers": 1.0, "slip": 0.9, "imprint": 0.6}
    cost_ms = {part: [ms, 2 * ms, 3 * ms] for part, ms in {"whole": 2.9, **parts}.items()}
    return {**frames, "armed_frames": [*armed], "refused": [], "cost_ms": cost_ms}


def row(run, slip=None, lost=None, opened=13, markers=None, released=None, borne=(), live=None):
    frames = {"contact_frame": 20, "hold_frame": 30, "slip_frame": slip, "lost_frame": lost}
    frames |= {"released_frame": released, "borne_frames": [*borne]}
    fingers = {"camera_0": {"slip_frame": None}, "camera_2": {"slip_frame": markers}}
    counts = {"ambiguous_n": 1, "ms_a_frame": 2.0, "live": live}
    return {"run": run, "frames_n": 130, **frames, "open_frame": opened, "fingers": fingers, **counts}


def rows():
    return [
        row("box_1_slip", slip=50, lost=62, live=live(imprint=[50], markers=[38])),
        row("box_2_slip", slip=58, lost=70, markers=55, live=live(stalled=[56], imprint=[58])),
        row("box_3_slip", lost=61),
        row("tin_4_hold", slip=80, markers=90, live=live(stalled=[70], imprint=[80], other=[99])),
        row("box_5_hold", lost=91),
        row("tin_6_hold", opened=None),
        row("can_7_slip", slip=None, lost=62),
        row("can_8_hold"),
    ]


def evidence(sliding=("box_1_slip", "can_7_slip"), walking=(), still=()):
    """Terms of each frame: noise, and a changed imprint while the object slides; it walks far, or nowhere."""
    rng, terms_of = np.random.default_rng(2), {}
    for one in rows():
        terms = rng.normal(0, 0.1, (130, 7))
        terms[44:54, :3] += 4.0 * (one["run"] in sliding)
        terms[:, 5:] += (-6.0 if one["run"] in still else -1.0, -3.0)
        terms[48:52, 6] += 3.0 * (one["run"] in walking)
        terms_of[one["run"]] = [None, *terms[1:].tolist()]
    return terms_of


def test_only_what_is_told_in_time_counts():
    result = figures(rows(), LABELS, evidence())
    names = ("lost", "warned", "slip_of_held")
    counted = {name: (result[name]["hits"], result[name]["runs"]) for name in names}
    assert counted == {"lost": (3, 4), "warned": (1, 3), "slip_of_held": (1, 4)}
    by_markers = detectors(result)["markers alone, limit for clips"]
    assert [(by_markers[name]["hits"], by_markers[name]["runs"]) for name in ("warned", "false")] == [(1, 3), (1, 4)]
    assert (result["lost_of_held"]["hits"], result["lost_of_held_to_the_end"]["hits"]) == (1, 0)
    assert result["without_open_frame"] == 1


def detectors(result):
    return {one["name"]: one for one in result["detectors"]}


def test_what_runs_live_comes_first_and_alarms_where_any_part_of_it_does():
    result = figures(rows(), LABELS, evidence())
    first = result["detectors"][0]
    assert (first["warned"]["hits"], first["early"], first["lead"][0], first["false"]["hits"]) == (1, 1, 22, 1)
    assert first["ms"] == pytest.approx(2.9)
    alone = detectors(result)["witness alone, as live"]
    assert (alone["warned"]["hits"], alone["early"], alone["lead"][0], alone["false"]["hits"]) == (1, 0, 10, 1)
    assert alone["ms"] == pytest.approx(2.0)
    assert (result["stopped_for_other"]["hits"], result["stalled_of_held"]) == (1, 1)
    assert result["runs"][0] | {"live": 38, "cause": "markers", "lead": 22} == result["runs"][0]
    assert len(result["runs"]) == len(rows()), "held runs are listed, too"


def test_a_slide_that_nobody_watches_for_is_no_alarm_of_what_runs_live():
    def left_out(armed):
        changed = [
            row("can_7_slip", lost=62, live=live(armed)) if one["run"] == "can_7_slip" else one for one in rows()
        ]
        return figures(changed, LABELS, evidence())["detectors"][1]["warned"]["hits"]

    assert left_out(range(32, 60)) == left_out(()) + 1


@pytest.mark.parametrize(
    ("alarm", "slide", "down", "met"),
    [
        (74, None, 75, "neither"),
        (75, None, 75, "put down"),
        (39, 40, 75, "neither"),
        (40, 40, 75, "sliding"),
        (75, 40, 75, "put down"),
        (99, None, None, "neither"),
    ],
)
def test_an_alarm_in_a_held_run_meets_what_its_labels_say(alarm, slide, down, met):
    labels = {"held": {"tin_4_hold": {"slide": slide}}, "set_down": {} if down is None else {"tin_4_hold": down}}
    assert occasion(alarm, "tin_4_hold", labels) == met


def test_what_alarms_in_held_runs_met_is_counted_by_the_first_of_each():
    result = detectors(figures(rows(), LABELS, evidence()))
    assert result["markers alone, as live"]["occasions"] == {"neither": 1}, "it stops at 70, before 75"
    assert result["witness alone, as live"]["occasions"] == {"put down": 1}, "it stops at 80"


def test_intervals_are_exact():
    assert share([True] * 3 + [False] * 63)["share"] == pytest.approx((0.0455, 0.0095, 0.1271), abs=1e-4)
    assert share([False] * 50)["share"] == pytest.approx((0.0, 0.0, 0.0711), abs=1e-4)


def test_the_witness_is_judged_on_objects_that_it_was_not_fitted_on():
    result = figures(rows(), LABELS, evidence())["witness"]
    assert result["witness_warned"]["hits"] >= 2
    assert result["auc"] > 0.6
    nobody_else = figures(rows(), LABELS, evidence(sliding=("can_7_slip",)))["witness"]
    assert nobody_else["auc"] < result["auc"] - 0.2


def test_an_imprint_that_walks_is_no_hold_and_one_that_moves_nowhere_no_slide():
    def warned(**how):
        return figures(rows(), LABELS, evidence(**how))["witness"]["witness_warned"]["hits"]

    assert warned(walking=["box_2_slip"]) == warned() + 1
    assert warned(still=["can_7_slip"]) == warned() - 1


def test_an_alarm_while_something_else_bears_the_object_or_of_empty_gels_does_not_count():
    def counted(**how):
        changed = [row("can_7_slip", **how) if one["run"] == "can_7_slip" else one for one in rows()]
        return figures(changed, LABELS, evidence())["witness"]["witness_warned"]["hits"]

    assert counted(lost=62) == counted(released=62) == 2
    assert counted(lost=62, borne=range(40, 60)) == 1
    assert counted(lost=45) == 1, "the first of the two empty frames is the first of the slide's evidence"
    assert counted(lost=46) == 2


def test_ends_are_counted_as_lost_or_released():
    changed = [row("box_5_hold", released=91) if one["run"] == "box_5_hold" else one for one in rows()]
    changed[0] = row("box_1_slip", released=62)
    result = figures(changed, LABELS, evidence())
    names = ("lost", "lost_of_held", "released_of_emptied", "released_of_lost")
    assert [result[name]["hits"] for name in names] == [2, 0, 1, 1]


def test_the_page_is_written_from_rows_and_labels_and_refuses_a_part(tmp_path, capsys):
    for name, content in (("rows", rows()), ("labels", LABELS), ("evidence", evidence())):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    given = [f"--{name}={tmp_path}/{name}.json" for name in ("rows", "labels", "evidence")] + [f"--out={tmp_path}"]
    (tmp_path / "real_grasps.json").write_text(json.dumps({"note": "The worst of it."}))
    assert main(["grasps", *given]) == 0
    text = (tmp_path / "real_grasps.md").read_text()
    assert "| box_2_slip | 40 | - | 60 | 20 | 30 | 58 | 70 | - | 56 | stalled | 4 |" in text
    assert "it detects 1 of 3 visible slides" in " ".join(text.split())
    assert "worst of it" in text, "what was written by hand stays"
    (tmp_path / "rows.json").write_text(json.dumps(rows()[1:]))
    assert main(["grasps", *given]) == 2
    assert "no rows of box_1_slip" in capsys.readouterr().err
