"""`evaluate` checks how a world is wired before it plays anything there, as a cell that inserts has to be."""

import json
from pathlib import Path

import pytest

from service.contract.shipped import released_models
from simulation.cli import evaluate
from simulation.closed_loop import campaign
from simulation.closed_loop.job import Job
from simulation.closed_loop.statistics import Row
from tests.simulation.closed_loop.test_evaluation import ROW
from tests.simulation.studies.test_wiring import probe

SWAPPED = "corrections in x reach the arm reversed, or the fingers are swapped"


@pytest.fixture
def worlds(tmp_path: Path) -> list[str]:
    """Files of a good world and of one with swapped fingers."""
    (tmp_path / "good.toml").write_text("")
    (tmp_path / "swapped.toml").write_text("[world]\nswapped_fingers = true\n")
    return [str(tmp_path / f"{name}.toml") for name in ("good", "swapped")]


def evaluated(worlds: list[str], models: Path, out: Path, *more: str) -> dict[str, Row]:
    """The row of each world."""
    asked = ["--worlds", *worlds, "--count", "2", "--perception", "fields", "-j", "1", "--models", str(models)]
    assert evaluate.main([*asked, "--json", str(out), *more]) == 0
    return {row["world"]: row for row in json.loads(out.read_text())}


def as_wired(task: campaign.Task) -> Row:
    """What a cell of this world answers: probes as it is wired, insertions always inserted in one attempt."""
    job = dict(task.job)
    if job.get("purpose") != "probe":
        return {**ROW, **job, "attempts": 1, "made_by": task.made_by}
    sign = -1.0 if job["unstated"].get("swapped_fingers") else 1.0
    answer = probe(job["x_mm"], job["theta_deg"], (sign * job["x_mm"], job["theta_deg"]))
    return {**ROW, **answer, **job, "made_by": task.made_by}


def test_nothing_is_inserted_in_a_cell_that_is_wired_wrong(worlds, models_folder, tmp_path, monkeypatch):
    played = list[campaign.Task]()

    def play(task: campaign.Task) -> Row:
        played.append(task)
        return as_wired(task)

    monkeypatch.setattr(campaign, "play", play)
    rows = evaluated(worlds, models_folder, tmp_path / "rows.json", "--objects", "circle", "rectangle")
    assert {task.job["condition"] for task in played if task.job.get("purpose") != "probe"} == {"good"}
    assert rows["good"]["inserted"] == rows["good"]["insertions"] == 2
    refused = rows["swapped"]
    assert (refused["refused"], refused["inserted"], refused["void"], refused["mean_trials"]) == (2, 0, 0, 16.0)
    assert refused["reasons"] == {f"commissioning: contradictory: {SWAPPED}": 2}

    again = evaluated(worlds, models_folder, tmp_path / "blind.json", "--objects", "circle", "--uncommissioned")
    assert again["swapped"]["inserted"] == 2
    assert {task.job["commissioned"] for task in played[-4:]} == {False}


def test_another_object_is_tried_where_the_first_cannot_be_held(worlds, models_folder, tmp_path, monkeypatch):
    not_held = {"reason": "service: refused: nothing_held", "trials": []}

    def play(task: campaign.Task) -> Row:
        answer = as_wired(task)
        return {**answer, **not_held} if task.job["scene"] == "rectangle" else answer

    monkeypatch.setattr(campaign, "play", play)
    rows = evaluated(worlds, models_folder, tmp_path / "rows.json", "--objects", "rectangle", "circle")
    assert rows["swapped"]["refused"] == 2
    alone = evaluated(worlds, models_folder, tmp_path / "alone.json", "--objects", "rectangle")
    assert not any("contradictory" in reason for reason in alone["swapped"]["reasons"])  # nobody could tell


def test_another_object_is_tried_where_the_first_goes_in(worlds, models_folder, tmp_path, monkeypatch):
    def play(task: campaign.Task) -> Row:
        answer = as_wired(task)
        return {**answer, "trials": []} if task.job["scene"] == "rectangle" else answer

    monkeypatch.setattr(campaign, "play", play)
    rows = evaluated(worlds, models_folder, tmp_path / "rows.json", "--objects", "rectangle", "circle")
    assert rows["swapped"]["reasons"] == {f"commissioning: contradictory: {SWAPPED}": 2}


@pytest.mark.parametrize(("gap_mm", "refused"), [(64.0, 2), (90.0, 0)])
def test_blocks_too_low_to_be_felt_are_named_unless_the_gap_is_that_wide(
    gap_mm, refused, worlds, models_folder, tmp_path, monkeypatch
):
    """With tops as low as the probes go, full depth is reached above them, and would be claimed."""
    monkeypatch.setattr(campaign, "play", lambda task: {**as_wired(task), "trials": []})
    box = tmp_path / "box.toml"
    box.write_text(f'[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 90.0\n[blocks]\ngap_mm = {gap_mm}\n')
    row = evaluated(worlds[:1], models_folder, tmp_path / "rows.json", "--objects", str(box))["good"]
    assert row["refused"] == refused
    assert any("nothing was felt 8 mm beside the gap" in reason for reason in row["reasons"]) == bool(refused)


def test_blocks_that_the_object_is_set_down_on_are_named(worlds, models_folder, tmp_path, monkeypatch):
    """Pushed through the hand by both blocks at once, it moves no marker on the way down, and would be claimed."""
    turned = {"reason": "service: refused: turned_in_hand: it hangs turned by 1.5 deg or more", "trials": []}

    def play(task: campaign.Task) -> Row:
        answer = as_wired(task)
        high = task.job["scene"] == "rectangle" or task.job["unstated"].get("swapped_fingers")
        return {**answer, **turned} if high and task.job.get("purpose") == "probe" else answer

    monkeypatch.setattr(campaign, "play", play)
    rows = evaluated(worlds, models_folder, tmp_path / "rows.json", "--objects", "rectangle", "circle")
    assert any("tops higher than taught" in reason for reason in rows["swapped"]["reasons"])
    assert rows["good"]["inserted"] == 2  # another object was held and felt the blocks


def test_a_sensor_that_the_networks_do_not_read_is_named_before_anything_is_played(
    models_folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(campaign, "play", lambda _: pytest.fail("played"))
    (tmp_path / "mini.toml").write_text('[camera]\nsensor = "gelsight_mini"\n')
    with pytest.raises(ValueError, match="world mini, object circle: pictures of the sensor gelsight_mini are 320 x"):
        evaluated([str(tmp_path / "mini.toml")], models_folder, tmp_path / "rows.json", "--objects", "circle")


def test_a_sensor_with_pictures_of_another_scale_is_named_before_anything_is_played(
    models_folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(campaign, "play", lambda _: pytest.fail("played"))
    (tmp_path / "far.toml").write_text("[camera.sensor]\nmm_per_px = 0.06\n")
    with pytest.raises(ValueError, match=r"327 x 320 px of 0\.06 mm; .* read 327 x 320 px of 0\.07 mm"):
        evaluated([str(tmp_path / "far.toml")], models_folder, tmp_path / "rows.json", "--objects", "circle")


def test_a_folder_in_place_of_the_file_for_rows_is_refused_before_anything_is_played(
    worlds, models_folder, tmp_path, monkeypatch
):
    monkeypatch.setattr(campaign, "play", lambda _: pytest.fail("played"))
    with pytest.raises(ValueError, match=r"is a folder; expected a file for the rows"):
        evaluated(worlds, models_folder, tmp_path, "--objects", "circle")


def test_rows_of_an_object_that_was_edited_since_are_played_again(worlds, models_folder, tmp_path, monkeypatch):
    played = list[float]()

    def play(task: campaign.Task) -> Row:
        played.append(Job(**task.job).build_scene().object.mass_kg)
        return as_wired(task)

    monkeypatch.setattr(campaign, "play", play)
    mine = tmp_path / "mine.toml"
    for mass_kg in (0.1, 0.5, 0.5):
        shape = '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 90.0\n'
        mine.write_text(f"order = 4\n{shape}mass_kg = {mass_kg}\n")
        evaluated(worlds[:1], models_folder, tmp_path / "rows.json", "--objects", str(mine), "--uncommissioned")
    assert played == [0.1, 0.1, 0.5, 0.5]


def test_figures_of_the_paper_are_those_of_the_objects_own_file(worlds, models_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "play", as_wired)
    body = '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 90.0\n'
    (tmp_path / "circle.toml").write_text(body)  # another object than the registry's of this name
    (tmp_path / "box.toml").write_text(body + "[paper]\nsuccess = 1.0\nmean_trials = 3.5\n")
    files = [str(tmp_path / f"{name}.toml") for name in ("circle", "box")]
    evaluated(worlds[:1], models_folder, tmp_path / "rows.json", "--objects", *files, "--uncommissioned")
    shown = capsys.readouterr().out
    assert "good, circle: 2/2 inserted, mean trials 1.00 (simulated)" in shown
    assert "good, box: 2/2 inserted, mean trials 1.00 (simulated; the paper's real robot: 3.5)" in shown


def test_a_false_claim_is_shown_with_what_was_refused(worlds, models_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "play", lambda task: as_wired(task) | {"inserted": False, "claimed": True})
    evaluated(worlds[:1], models_folder, tmp_path / "rows.json", "--objects", "circle")
    shown = capsys.readouterr().out
    assert "good, circle: 0/2 inserted, mean trials 16.00 (simulated" in shown
    assert "\n  2 x claimed, but not inserted\n" in shown


@pytest.mark.slow
def test_swapped_fingers_are_named_by_what_the_cell_really_feels(worlds, tmp_path):
    rows = evaluated(worlds, released_models(), tmp_path / "rows.json", "--objects", "rectangle")
    assert rows["good"]["inserted"] == 2
    assert rows["swapped"]["reasons"] == {f"commissioning: contradictory: {SWAPPED}": 2}
