"""Identification from presses: intervals hold their coverage, and undetermined parameters keep their full width."""

import json
from dataclasses import replace

import numpy as np
import pytest

from robot_client.session.commission.run import PRESSES
from robot_client.session.commission.wiring import SIDES
from service.contract import ContractError, Sensor
from service.contract.model_card import CONDITIONS
from service.contract.shipped import released_models
from simulation.__main__ import main
from simulation.scene.worlds import load_world
from simulation.studies.identify import posterior, recorded, study
from simulation.studies.identify.cells import Cell, pressed, second_grip_n
from tests.robot_client.insertion.stories import no_decision
from tests.simulation.data.test_sources import as_if_changed

CELL = 5


def numbers(truth, rng):
    """Cells that show the first parameter, and the second where the first is large, and nothing else."""
    noise = rng.normal(0.0, 0.02, (len(truth), 2))
    shown = np.stack([truth[:, 0], np.where(truth[:, 0] > 0.5, truth[:, 1], 0.5)], 1) + noise
    return np.hstack([shown, rng.normal(0.0, 1.0, (len(truth), 48))])


@pytest.fixture(scope="module")
def made():
    rng = np.random.default_rng(1)
    truth = rng.random((600, len(posterior.PARAMETERS)))
    tiers = np.where(np.arange(600) > 200, "bristle", "layer")
    return posterior.fit(numbers(truth, rng), truth, tiers, {"made_by": "a test"})


def test_nine_of_ten_fresh_cells_lie_within_their_intervals(made):
    rng = np.random.default_rng(2)
    truth = rng.random((2000, len(posterior.PARAMETERS)))
    _, low, high = made.shares(numbers(truth, rng))
    held = ((truth >= low) & (truth <= high)).mean(0)
    assert np.all((held > 0.86) & (held < 0.94))


def test_what_is_not_shown_is_as_wide_as_before_and_what_is_shown_is_not(made):
    rng = np.random.default_rng(3)
    intervals = made.intervals(numbers(np.full((1, len(posterior.PARAMETERS)), 0.7), rng)[0])
    assert intervals[0].known
    assert not any(one.known for one in intervals[2:])
    assert all(one.low <= one.estimate <= one.high for one in intervals)


def test_numbers_like_no_drawn_cells_are_refused(made):
    with pytest.raises(ContractError, match="like none of the 600 simulated cells"):
        made.intervals(np.full(50, 40.0))
    with pytest.raises(ContractError, match="too few markers"):
        made.intervals(np.full(50, np.nan))


def test_a_parameter_keeps_its_range():
    for one in posterior.PARAMETERS:
        ends = [one.value(share) for share in (0.0, 1.0)]
        assert ends == pytest.approx([one.low, one.high])
        assert one.share(one.value(0.3)) == pytest.approx(0.3)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The recordings of a drawn cell that pressed, and its row."""
    folder = tmp_path_factory.mktemp("cell")
    return folder, pressed(Cell(CELL, folder, released_models()))


def test_the_recordings_of_a_cell_become_a_world_file(played, tmp_path, capsys):
    folder, row = played
    out = tmp_path / "cell.toml"
    assert main(["scene", "identify", str(folder), "--object", str(folder / "object.toml"), "--out", str(out)]) == 0
    changes = load_world(out).changes
    assert changes["grasp.force_n"] == pytest.approx(row["tables"]["grasp"]["force_n"], rel=1e-4)
    content = json.loads(out.with_suffix(".json").read_text())
    assert set(content["gel"]) == {one.key for one in posterior.PARAMETERS}
    assert content["posterior"]["made_by"].startswith("python -m simulation scene fit")
    unknown = [key for key, one in content["gel"].items() if not one["known"]]
    assert out.read_text().count("not determined by the probes") == len(unknown)
    assert capsys.readouterr().out.count("not determined by the probes") == len(unknown)


def test_the_shipped_posterior_knows_the_stiffness_of_a_cell_that_it_was_not_fitted_to(played):
    intervals = posterior.load().intervals(np.array(played[1]["numbers"]))
    gel = next(one for one in intervals if one.key == "shear_modulus_n_per_mm2")
    assert gel.known
    assert study.scored(played[1], posterior.load())["gel"]["friction"]["width"] <= 1.3


def test_presses_that_do_not_tell_are_refused_by_name(played):
    folder, _ = played
    probes = recorded.read(folder)
    own, other = probes.presses
    for presses, says in (
        ({}, "presses at no grip"),
        ({own: probes.presses[own]}, f"presses at {own:g} N"),
        ({own: probes.presses[own], 1.1 * own: probes.presses[other]}, "one twice the other"),
    ):
        with pytest.raises(ContractError, match=says):
            recorded.sorted_out(probes.signs, presses)
    with pytest.raises(ContractError, match="no probe for signs"):
        recorded.read(folder / "00")
    slowed = [replace(one, speed_mm_s=4.0) for one in probes.presses[other]]
    with pytest.raises(ContractError, match=r"probes at 4 to 5 mm/s; expected 4\.8 to 5\.2"):
        recorded.sorted_out(probes.signs, {**probes.presses, other: slowed})


BEGUN = [*((40.0, start) for start in SIDES), *((grip, start) for grip in (40.0, 20.0) for start in PRESSES)]


def recordings_of(root, probes, held_px=0.0, decision="{}"):
    """Recordings of probes of these grips and starts, after those that are there."""
    sensor, before_n = Sensor.load(), len([*root.iterdir()])
    held = np.full((2, sensor.marker_rows, sensor.marker_columns, 2), held_px)
    for number, (grip_n, (x_mm, yaw_deg)) in enumerate(probes, before_n):
        folder = root / f"{number:02d}"
        folder.mkdir()
        approach = {"x_mm": x_mm, "yaw_deg": yaw_deg}
        (folder / "summary.json").write_text(json.dumps({"purpose": "probe", "approach": approach}))
        conditions = [grip_n if name == "grip_n" else 5.0 for name in CONDITIONS]
        arrays = {"held_px": held, "conditions": conditions, "decision": decision}
        np.savez(folder / "attempt_01.npz", steps=np.zeros((5, 2, 13, 13, 3)), **arrays)


def test_a_probe_to_learn_from_that_begins_near_a_press_is_none(tmp_path):
    """It is stopped long before the gel slides; of four seeds of 150 probes, one draws some so near."""
    recordings_of(tmp_path, [*BEGUN, (40.0, (0.3, 14.6)), (40.0, (-7.71, 7.8))])
    probes = recorded.read(tmp_path)
    assert [(one.x_mm, one.yaw_deg) for one in probes.signs] == [*SIDES]
    assert [(grip, len(made)) for grip, made in probes.presses.items()] == [(40.0, 2), (20.0, 2)]


def test_a_press_in_which_the_arm_paused_tells_nothing_of_the_gel(tmp_path):
    """`commission` makes it again for that."""
    recordings_of(tmp_path, BEGUN[:6])
    recordings_of(tmp_path, BEGUN[6:7], held_px=1.0, decision=no_decision(1, "stale").model_dump_json())
    recordings_of(tmp_path, BEGUN[6:])
    assert [float(one.markers_px.mean()) for one in recorded.read(tmp_path).presses[20.0]] == [0.0, 0.0]


@pytest.mark.parametrize("left", [0, 200, None])  # None: all of it, as zeros
def test_a_press_that_a_power_cut_damaged_is_named_and_the_others_are_read_without_it(tmp_path, left):
    recordings_of(tmp_path, BEGUN)
    path = tmp_path / f"{len(BEGUN) - 1:02d}" / "attempt_01.npz"
    path.write_bytes(bytes(path.stat().st_size) if left is None else path.read_bytes()[:left])
    with pytest.raises(ContractError, match=f"{path} is damaged .*; remove it, and the other probes are read"):
        recorded.read(tmp_path)
    path.unlink()
    assert sum(len(made) for made in recorded.read(tmp_path).presses.values()) == 3


def test_only_the_newest_commissioning_identifies_a_gel(tmp_path):
    """Another gel may be in the fingers since."""
    recordings_of(tmp_path, BEGUN, held_px=1.0)
    recordings_of(tmp_path, BEGUN, held_px=2.0)
    probes = recorded.read(tmp_path)
    made = [*probes.signs, *probes.presses[40.0], *probes.presses[20.0]]
    assert [float(one.markers_px.mean()) for one in made] == [2.0] * len(BEGUN)


def test_cells_press_again_where_the_code_that_played_them_has_changed(tmp_path, monkeypatch):
    folders, numbers = [], []
    monkeypatch.setattr(study, "pressed", lambda cell: folders.append(cell.folder) or {"number": cell.number})
    monkeypatch.setattr(study, "scored", lambda row, _: numbers.append(row["number"]) or {"refused": "", "tier": ""})
    words = ["scene", "judge", "--out", str(tmp_path), "--cells", "2", "--layer-cells", "0", "--workers", "1"]
    for file in ("", "simulation/physics/quasistatic.py", "simulation/studies/episodes.py"):
        with monkeypatch.context() as patch:
            patch.setattr("simulation.cli.commission.identify_page", lambda _: "")
            if file:
                as_if_changed(patch, file)
            assert main(words) == main(words) == 0
    assert len(set(folders)) == 3 * 2
    assert len(numbers) == len(folders) == 2 * len(set(folders))


@pytest.mark.parametrize("grip_n", [10.0, 19.9, 20.0, 40.0])
def test_the_second_grip_stays_within_what_the_networks_were_trained_on(grip_n):
    assert recorded.GRIPS_N[0] <= second_grip_n(grip_n) <= recorded.GRIPS_N[1]


def test_a_part_that_does_not_cover_the_pads_is_refused(played):
    from simulation.scene.worlds import load_scene

    probes = recorded.read(played[0])
    with pytest.raises(ContractError, match="expected a rectangle"):
        probes.numbers(load_scene("circle"))
