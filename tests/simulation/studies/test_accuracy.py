"""The cost of accuracy is measured as documented, and hard probes are one resumable command."""

import json
from pathlib import Path

import pytest

from simulation.__main__ import main
from simulation.scene.worlds import training_objects
from simulation.studies import accuracy, accuracy_report, hard_probes_report

DOCS = Path(__file__).parents[3] / "docs"


def test_the_published_table_has_enough_settings_and_scenes_and_both_tiers() -> None:
    costs = json.loads((DOCS / "accuracy.json").read_text())["costs"]
    assert {row["scene"] for row in costs} == set(training_objects())
    assert {row["setting"] for row in costs} == {setting.name for setting in accuracy.SETTINGS}
    assert {row["family"] for row in costs} == {"load step", "nodes", "effects", "layer"}
    for row in costs:
        if row["setting"].startswith("default"):
            assert row["numerical"]["position_um"] < 10.0
            assert row["numerical"]["turn_deg"] < 0.01


def test_finer_nodes_err_less_and_the_tiers_differ_by_a_model() -> None:
    coarse, fine = (accuracy.poke("hexagon", "bristle", changes, 1) for changes in (accuracy.COARSE, {}))
    reference = accuracy.poke("hexagon", "bristle", accuracy.FINE, 1)
    layer = accuracy.poke("hexagon", "layer", {}, 1)
    assert accuracy.error_of(fine, reference).markers_um < 0.5 * accuracy.error_of(coarse, reference).markers_um
    assert accuracy.error_of(fine, layer).markers_um > 5.0 * accuracy.error_of(fine, reference).markers_um


@pytest.mark.slow
def test_the_picture_is_drawn_from_the_published_figures(tmp_path: Path) -> None:
    published = json.loads((DOCS / "accuracy.json").read_text())
    accuracy_report.draw(published["costs"], tmp_path / "accuracy.png")
    assert (tmp_path / "accuracy.png").stat().st_size > 20_000


@pytest.mark.slow
def test_interrupted_hard_probes_go_on_where_they_stopped(tmp_path: Path, capsys) -> None:
    command = ["hard-probes", "--seed", "12", "-j", "1", "--out", str(tmp_path)]
    assert main([*command, "-n", "50"]) == 0
    first = json.loads((tmp_path / "hard_probes.bristle.json").read_text())
    assert main([*command, "-n", "60"]) == 0
    both = json.loads((tmp_path / "hard_probes.bristle.json").read_text())
    assert (first["probes"], both["probes"]) == (50, 60)
    assert both["worst_residual_n"] <= 1e-6
    assert both["worst_cone_violation_n_per_mm2"] <= 1e-9
    assert both["ended"]["solved"] > first["ended"]["solved"]
    assert "All 60 probes of seed 12" in capsys.readouterr().out


def test_hard_probes_of_another_physics_are_not_taken_over(tmp_path: Path) -> None:
    """The file of the build before would otherwise be printed as if today's had been tried."""
    command = ["hard-probes", "-n", "1", "-j", "1", "--out", str(tmp_path)]
    path = tmp_path / "hard_probes.bristle.json"
    assert main(command) == 0
    true = json.loads(path.read_text())
    path.write_text(json.dumps(true | {"physics": "0" * 64, "ended": {"solved by the build before": 1}}))
    assert main(command) == 0
    assert json.loads(path.read_text())["ended"] == true["ended"]


@pytest.mark.parametrize("text", ["{", "[]", '{"seed": 12', "null"])
def test_a_tally_of_hard_probes_that_cannot_be_read_is_named(tmp_path: Path, capsys, text) -> None:
    (tmp_path / "hard_probes.bristle.json").write_text(text)
    assert main(["hard-probes", "-n", "1", "-j", "1", "--out", str(tmp_path)]) == 2
    assert "hard_probes.bristle.json is not what an earlier run left" in capsys.readouterr().err


def test_ten_thousand_published_hard_probes_kept_every_promise() -> None:
    kept = json.loads((DOCS / "hard_probes.bristle.json").read_text())
    assert kept["probes"] == sum(kept["ended"].values()) == 10_000
    assert all(name in ("solved", "grasp lost") or name.startswith("refused: ") for name in kept["ended"])
    assert hard_probes_report.hard_probes_page(kept) == (DOCS / "hard_probes.md").read_text()
    assert kept["worst_residual_n"] <= 1e-6
    assert kept["worst_cone_violation_n_per_mm2"] <= 1e-9


@pytest.mark.parametrize("wrong", [["--count", "0"], ["--out", "/no/such/folder"]])
def test_a_wrong_hard_probe_run_is_one_line(wrong: list[str], capsys) -> None:
    assert main(["hard-probes", *wrong]) == 2
    assert capsys.readouterr().err.count("\n") == 1
