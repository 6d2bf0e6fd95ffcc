"""Nobody can choose what a sealed test plays, a larger one extends a smaller one, and its page lists every failure."""

import shutil

import pytest

from simulation.studies.witness import sealed
from simulation.studies.witness.sealed_page import foreign_world_page

OBJECTS = ["can", "white_box", "vitamin", "mustard"]
SEALED = {"seal": "seal", "counter": 1, "count": 12}


@pytest.fixture
def release(tmp_path):
    folder = tmp_path / "models"
    shutil.copytree("models/pressing", folder)
    return folder


def test_another_byte_or_counter_is_another_test(release):
    first = sealed.seal(release, 1)
    assert first == sealed.seal(release, 1) != sealed.seal(release, 2)
    with (release / "joint" / "joint.step.onnx").open("ab") as file:
        file.write(b"\0")
    assert sealed.seal(release, 1) != first
    starts = [[each.start.x_mm for each in sealed.opened(seal, OBJECTS, 5)] for seal in (first, "other")]
    assert starts[0] != starts[1]


def test_more_insertions_begin_with_the_same_ones_and_families_differ():
    few, many = sealed.opened("seal", OBJECTS, 5), sealed.opened("seal", OBJECTS, 7)
    assert few == many[: len(few)]
    assert [each.family for each in few] == [family for family in sealed.FAMILIES for _ in range(5)]
    for each in many:
        gel = each.start.world.changes
        assert gel["gel.relaxation_share"] == 0.0
        assert gel["gel.poisson_ratio"] >= 0.45
        if each.family == "edges near":
            assert max(gel["gel.margin_mm"]) <= 1.0
        elif each.family == "edges far":
            assert min(gel["gel.margin_mm"]) >= 5.0
        else:
            assert gel["gel.friction"] < 0.58


def test_the_page_begins_with_what_is_missed_and_lists_every_failure(release):
    begun = sealed.opened("seal", OBJECTS, 10)
    played = {
        cell: [row_of(task.job) for task in sealed.tasks("seal", release, first, cell)]
        for cell, first in ((sealed.WITNESS, begun), ("bristle", begun), ("recipe", begun[:15]))
    }
    assert {(job["cell"], job["perception"], job["controller"]) for job in played["recipe"]} == {
        ("foreign", "pictures", "heuristic")
    }
    rows = played[sealed.WITNESS]
    rows[3] |= {"inserted": False, "shortfalls": ("it is tilted by 2.55 deg, below 2 counts",)}
    rows[4] |= {"inserted": False, "claimed": False, "reason": "service: contradictory"}
    data = sealed.report_of(played, begun, {"seal": "seal", "counter": 1, "count": 10})
    by_cell = {row["cell"]: row["insertions"] for row in data["figures"] if row["family"] == "all"}
    assert by_cell == {sealed.WITNESS: 30, sealed.ALIKE: 15, "bristle": 30, "recipe": 15}
    assert {row["cell"] for row in data["figures"] if row["family"] != "all"} == {sealed.WITNESS}
    assert [row["reason"] for row in data["failed"]] == ["", "service: contradictory"]
    assert len(sealed.table_of(played, begun)) == 30 + 30 + 15
    text = foreign_world_page(data)
    assert text.index("**Missed:** 1 of 30 insertions ended in a false claim") < text.index("Reached")
    assert "claimed, but it is tilted by x deg, below 2 counts" in text
    assert "service: contradictory" in text
    assert "| finite elements, the paper's recipe | all |" in text


def test_failures_in_one_world_count_as_one_and_those_of_many_worlds_as_many(release):
    def inserted(failed):
        begun = sealed.opened("seal", OBJECTS, 12)
        rows = [row_of(task.job) for task in sealed.tasks("seal", release, begun, sealed.WITNESS)]
        for index in failed:
            rows[index] |= {"inserted": False, "claimed": False}
        text = foreign_world_page(sealed.report_of({sealed.WITNESS: rows}, begun, SEALED))
        return next(line for line in text.splitlines() if line.startswith("| finite elements | all |"))

    assert "| 86.1 % (71.3 .. 93.9) |" in inserted([0, 5, 10, 15, 20])
    assert "| 86.1 % (47.7 .. 97.7) |" in inserted([0, 1, 2, 3, 4])


def row_of(job):
    """A possible result of a job."""
    course = {"force_n": 12.0, "block_mm": 0.1}
    ended = {"inserted": True, "claimed": True, "in_gap": True, "void": False, "grasp_kept": True, "attempts": 1}
    return {**job, **ended, "reason": "", "shortfalls": (), "final_error": [0.0, 0.0], "trials": [], "course": course}
