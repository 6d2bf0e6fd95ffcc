"""The judgement of real recordings, on recordings made up: who is fitted on whom, and what the intervals say."""

import numpy as np
import pytest

from reporting.page import page
from simulation.__main__ import main
from simulation.studies.slip import real as slip_real
from simulation.studies.slip.real import GRID_PITCH, MARGIN, RealDataError, Recording, fitted, separation
from simulation.studies.slip.real_report import real_part
from tests.service.perception.synthetic import patch_fields, pressed, rigid


def grasp(name, *, slips, seed):
    still, _ = patch_fields(pressed(rigid()), frames=80, seed=seed)
    moving, _ = patch_fields(pressed(rigid((0, 1.5), 0.7)), hold_px=14, seed=seed)
    fields = [*still, *moving] if slips else [*still, *still[:40]]
    for k, field in enumerate(fields):
        fields[k] = type(field)(
            field.rest_px, field.displacement_px, field.valid, None, field.pitch_px, k * slip_real.FRAME_NS
        )
    return Recording(name, slips, (fields,))


@pytest.fixture(scope="module")
def recordings():
    held = [grasp(f"a_{k}_hold", slips=False, seed=k) for k in range(3)]
    return [*held, *(grasp(f"a_{k}_slip", slips=True, seed=k) for k in range(3, 5))]


def test_a_limit_is_the_least_silent_one_with_a_margin(recordings):
    held = recordings[:2]
    counts = {(r.name, pitch): int(pitch < 0.15 or pitch == 0.2) for r in held for pitch in GRID_PITCH}
    assert fitted(held, counts) == pytest.approx(MARGIN * 0.225), "an alarm above a silent limit counts"


@pytest.mark.slow
def test_each_half_is_judged_with_the_limit_of_the_other(recordings):
    result = slip_real.false_alarms(recordings)
    assert sum(fold["frames"] for fold in result["folds"]) == result["frames"]
    assert all(fold["limit_pitch"] in [MARGIN * pitch for pitch in GRID_PITCH] for fold in result["folds"])
    assert result["default"]["caught"] == 2


@pytest.mark.slow
def test_slip_and_hold_that_differ_are_told_apart(recordings):
    result = separation(recordings)
    assert result["ours"]["value"] == 1.0
    assert result["margin"]["interval"][0] <= result["margin"]["value"] <= result["margin"]["interval"][1]
    real = {"false_alarms": slip_real.false_alarms(recordings), "slip_against_hold": result, "loop_closure": None}
    assert ("does not beat" in page(*real_part(real))) == (result["margin"]["interval"][0] <= 0)


def test_a_folder_without_recordings_is_refused_in_one_line(tmp_path, capsys):
    with pytest.raises(RealDataError, match="gelsight_mini_slip"):
        slip_real.load(tmp_path, print)
    assert main(["slip-report", "--real", str(tmp_path), "--out", str(tmp_path)]) == 2
    assert main(["slip-report", "--parts", "trackers", "--out", str(tmp_path)]) == 2
    assert "slip_report.json is not there" in capsys.readouterr().err


def test_the_maxima_are_taken_over_the_same_length():
    slip, hold = [np.array([0.0, 1.0, 9.0])], [np.array([2.0, 0.0])]
    assert slip_real._wins([slip], [hold])[0, 0] == 0.0
