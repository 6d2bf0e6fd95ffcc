"""Collection: labels are true, groups stay whole, and a kill at any moment loses and duplicates nothing."""

import contextlib
import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from simulation.__main__ import main
from simulation.cli.dataset import CollectOptions, asked_manifest
from simulation.data.collect import POKES_PER_FIXTURE, Hand, Plan, draw_fixture, make_shard, pokes
from simulation.data.dataset import Dataset, DatasetError, DatasetWriter
from simulation.data.drawn_cells import base, mechanics
from simulation.data.manifest import read_manifest
from simulation.scene.scene import SceneError
from simulation.scene.worlds import load_scene
from tests.simulation.data.test_sources import as_if_changed

WORDS = ["collect", "--objects", "circle", "--trials-per-shard", "3"]
COLLECT = [sys.executable, "-m", "simulation", *WORDS]


def plan(folder: Path, **changes: object) -> Plan:
    return dataclasses.replace(Plan(folder, "circle", 0, 4, 0, 0.3), **changes)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One finished collection of 6 collisions, through the command line."""
    folder = tmp_path_factory.mktemp("collected")
    assert main([*WORDS, "--out", str(folder), "--trials-per-object", "6", "--workers", "1"]) == 0
    return folder


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("*.parquet")}


def test_a_shard_follows_from_its_plan_alone(tmp_path: Path) -> None:
    first = make_shard(plan(tmp_path))
    assert make_shard(plan(tmp_path)) == first
    assert make_shard(plan(tmp_path, seed=1)).sha256 != first.sha256
    assert first.outcomes["blocked"] == first.trials == 4


def test_around_a_cell_what_is_known_is_kept_and_the_rest_is_drawn(tmp_path: Path) -> None:
    known = {"grasp": {"force_n": 21.5, "height_mm": 33.0}}
    circle = load_scene("circle")
    cells = [draw_fixture(circle, plan(tmp_path, known=known), number)[0] for number in range(5)]
    assert {(cell.scene.grasp.force_n, cell.scene.grasp.height_mm) for cell in cells} == {(21.5, 33.0)}
    assert all(cell.scene.object == circle.object for cell in cells)
    assert len({cell.scene.gel.shear_modulus_n_per_mm2 for cell in cells}) == 5
    stiff = draw_fixture(circle, plan(tmp_path, known={"gel": {"normal_ratio": 20.0}}), 0)[0].scene
    assert (stiff.gel.normal_ratio, stiff.gel.poisson_ratio) == (20.0, None), "a drawn ratio would replace it"
    with pytest.raises(SceneError, match="fits to what is known"):
        draw_fixture(circle, plan(tmp_path, known={"grasp": {"height_mm": 1e6}}), 0)


@pytest.mark.parametrize("tier", ["bristle", "layer"])
def test_cells_of_one_tier_are_all_of_it(tmp_path: Path, tier: str) -> None:
    of_tier = plan(tmp_path, scene_name=f"drawn-{tier}")
    cells = [draw_fixture(base(of_tier.scene_name), of_tier, number)[0] for number in range(8)]
    assert {cell.scene.gel.tier for cell in cells} == {tier}


def test_a_press_in_finite_elements_moves_the_markers_as_our_own_gel_does(tmp_path: Path) -> None:
    """The same cell, pressed in both: the fields agree in direction, and are not the same."""
    of_elements = plan(tmp_path, scene_name="drawn-foreign")
    fixture, _ = draw_fixture(base("drawn-foreign"), of_elements, 1)
    moved = []
    for name in ("drawn-bristle", "drawn-foreign"):
        hand = Hand(fixture, mechanics(name))
        hand.aim(0.4 * fixture.scene.x_range_mm, 0.0)
        probe = hand.press(np.random.default_rng(0))
        assert probe.outcome == "blocked"
        moved.append((probe.gel[-1, ..., :2] - probe.gel[0, ..., :2]).astype(float).ravel())
    own, elements = moved
    assert 0.8 < own @ elements / np.linalg.norm(own) / np.linalg.norm(elements) < 0.9999


def test_presses_around_one_cell_are_not_continued_around_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.toml").write_text("[grasp]\nforce_n = 21.5\n")
    (tmp_path / "b.toml").write_text("[grasp]\nforce_n = 31.5\n")
    words = ["collect", "--out", str(tmp_path / "data"), "--trials-per-object", "2", "--workers", "1"]
    assert main([*words, "--objects", "circle", "--around", str(tmp_path / "a.toml")]) == 0
    dataset = Dataset(tmp_path / "data")
    assert {dataset.trial(index).grip_n for index in range(2)} == {21.5}
    assert main([*words, "--objects", "circle", "--around", str(tmp_path / "b.toml")]) == 2
    assert "made_by" in capsys.readouterr().err
    assert main([*words, "--objects", "drawn", "--around", str(tmp_path / "a.toml")]) == 2


def test_presses_around_a_cell_have_its_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mini.toml").write_text('[camera]\nsensor = "gelsight_mini"\n')
    words = ["collect", "--objects", "circle", "--around", str(tmp_path / "mini.toml"), "--out", str(tmp_path / "data")]
    assert main([*words, "--trials-per-object", "2", "--workers", "1"]) == 0
    assert Dataset(tmp_path / "data").trial(1).sensor.name == "gelsight_mini"
    assert main([*words, "--sensor", "gelslim_2019"]) == 2
    assert "--sensor gelslim_2019: circle has its own" in capsys.readouterr().err


def test_labels_are_the_true_errors_and_only_collisions_are_kept(made: Path) -> None:
    dataset = Dataset(made)
    assert dataset.manifest.complete
    scene = load_scene("circle")
    for index in range(len(dataset)):
        trial = dataset.trial(index)
        assert trial.outcome == "blocked"
        assert abs(trial.x_mm) < scene.x_range_mm + 3
        assert abs(trial.theta_deg) < scene.theta_range_deg + 5
        shear = np.abs(trial.gel[..., :2].astype(float) - trial.gel[0, ..., :2].astype(float)).max((1, 2, 3, 4))
        assert shear[trial.onset_frame] > 0
        assert shear[trial.onset_frame + 7] > 0.1, "8 frames from the onset show the collision"


def test_a_group_is_one_fixture_of_at_most_five_pokes(tmp_path: Path) -> None:
    pokes_of: dict[int, list[int]] = {}
    looks: dict[int, set[object]] = {}
    for count, (fixture, poke, _, _) in enumerate(pokes(plan(tmp_path), load_scene("circle"))):
        pokes_of.setdefault(fixture.group, []).append(poke)
        looks.setdefault(fixture.group, set()).add((fixture.appearances, fixture.scene.gel.friction))
        if count >= 7:
            break
    assert all(order == list(range(len(order))) and len(order) <= POKES_PER_FIXTURE for order in pokes_of.values())
    assert all(len(drawn) == 1 for drawn in looks.values())
    assert len({next(iter(drawn)) for drawn in looks.values()}) == len(pokes_of)


@pytest.mark.slow
def test_a_ray_cluster_makes_the_same_data(made: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    command = [*COLLECT, "--out", str(tmp_path), "--trials-per-object", "6", "--ray", "local"]
    subprocess.run(command, check=True, capture_output=True)
    assert digests(tmp_path) == digests(made)
    assert read_manifest(tmp_path) == read_manifest(made)


def alive(process_group: int) -> bool:
    try:
        os.killpg(process_group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("wait_for_shard", [False, True])
def test_kill_9_loses_nothing_and_doubles_nothing(made: Path, tmp_path: Path, wait_for_shard: bool) -> None:
    command = [*COLLECT, "--out", str(tmp_path), "--trials-per-object", "6", "--workers", "2"]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not (tmp_path / "manifest.json").exists():
        time.sleep(0.02)
    while wait_for_shard and time.monotonic() < deadline and not read_manifest(tmp_path).shards:
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 120  # its own: what comes before may have used up the first on a busy machine
    while alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(process.pid), "workers die with their parent"
    subprocess.run(command, check=True, capture_output=True)
    assert digests(tmp_path) == digests(made)
    assert read_manifest(tmp_path) == read_manifest(made)
    assert not list(tmp_path.glob(".*.tmp"))
    trials = [Dataset(tmp_path).trial(index) for index in range(len(Dataset(tmp_path)))]
    assert len({(trial.group, trial.poke) for trial in trials}) == len(trials) == 6


def test_a_finished_collection_is_left_as_it_is(made: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in made.glob("*.parquet")}
    assert main([*WORDS, "--out", str(made), "--trials-per-object", "6", "--workers", "1"]) == 0
    assert before == {path: path.stat().st_mtime_ns for path in made.glob("*.parquet")}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--trials-per-object", "0"], "at least 1"),
        (["--objects", "circel"], "circle"),
        (["--seed", "5"], "seed is 0, asked for 5"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(made: Path, arguments: list[str], message: str, capsys) -> None:
    before = digests(made)
    assert main([*WORDS, "--out", str(made), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert digests(made) == before


def test_shards_of_two_physics_are_not_mixed(tmp_path: Path) -> None:
    asked = asked_manifest(CollectOptions(objects=("circle",), trials_per_object=6, trials_per_shard=3))
    with DatasetWriter(tmp_path, asked.model_copy(update={"physics": "0" * 64})) as writer:
        before = (tmp_path / "manifest.json").read_bytes()
        with pytest.raises(DatasetError, match="the physics has changed"):
            writer.extend(asked)
        assert (tmp_path / "manifest.json").read_bytes() == before
        writer.extend(asked.model_copy(update={"physics": "0" * 64}))


@pytest.mark.parametrize("file", ["data/collect.py", "data/drawn_cells.py", "scene/drawn.py", "foreign/cell.py"])
def test_shards_are_of_one_physics_only_if_the_same_code_drew_and_pressed_their_cells(monkeypatch, file) -> None:
    asked = CollectOptions(objects=("drawn-foreign",), trials_per_object=6, trials_per_shard=3)
    before = asked_manifest(asked).physics
    as_if_changed(monkeypatch, f"simulation/{file}")
    assert asked_manifest(asked).physics != before


def test_two_scenes_of_one_name_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    mine = tmp_path / "circle.toml"
    mine.write_bytes((Path(__file__).parents[3] / "simulation/objects/circle.toml").read_bytes())
    for objects in (("circle", str(mine)), ()):
        with pytest.raises(DatasetError, match="no two of the same name"):
            asked_manifest(CollectOptions(objects=objects))
    DatasetWriter(tmp_path, asked_manifest(CollectOptions(out=tmp_path, objects=("circle", "rectangle")))).close()
    for objects, refused in ((("circle",), False), (("hexagon", "circle"), False), ((str(mine),), True)):
        with pytest.raises(DatasetError, match="are of circle; name that") if refused else contextlib.nullcontext():
            asked_manifest(CollectOptions(out=tmp_path, objects=objects))


def test_a_scene_that_never_collides_is_said_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulation.data.collect._MAX_POKES_PER_TRIAL", 3)
    scene = tmp_path / "roomy.toml"
    shape = '[object]\nshape = "rectangle"\nsize_x_mm = 10.0\nsize_y_mm = 10.0\n'
    scene.write_text(shape + "[blocks]\ngap_mm = 240.0\n")
    with pytest.raises(DatasetError, match="nothing to collect"):
        make_shard(plan(tmp_path, scene_name=str(scene), trials=1))


def test_a_scene_file_draws_the_same_wherever_it_lies(tmp_path: Path) -> None:
    here, there = (
        plan(tmp_path, scene_name="a/roomy.toml", trials=1),
        plan(tmp_path, scene_name="b/roomy.toml", trials=1),
    )
    assert here.group_id(3) == there.group_id(3) != plan(tmp_path, scene_name="a/tight.toml", trials=1).group_id(3)


def test_the_asked_size_is_rounded_up_to_whole_shards(tmp_path: Path) -> None:
    options = CollectOptions(out=tmp_path, trials_per_object=11, trials_per_shard=5, objects=("circle", "rectangle"))
    missing = asked_manifest(options).missing_shards()
    assert missing == [(name, n) for n in range(3) for name in ("circle", "rectangle")]


@pytest.mark.slow
def test_as_many_trials_as_are_asked_are_made_and_a_folder_keeps_its_shards(tmp_path):
    few = asked_manifest(CollectOptions(out=tmp_path, trials_per_object=4, objects=("circle",)))
    assert (few.trials_per_shard, len(few.missing_shards())) == (4, 1)
    with DatasetWriter(tmp_path, few):
        more = asked_manifest(CollectOptions(out=tmp_path, trials_per_object=600, objects=("circle",)))
    assert more.trials_per_shard == 4
    with pytest.raises(DatasetError, match="--sensor gelsight_mini: drawn has its own"):
        asked_manifest(CollectOptions(out=tmp_path / "other", objects=("drawn",), sensor="gelsight_mini"))
    fresh = asked_manifest(CollectOptions(out=tmp_path / "new", trials_per_object=600, objects=("circle",)))
    assert fresh.trials_per_shard == 250
