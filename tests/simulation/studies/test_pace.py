"""Choices of settings are played fairly, keep every bound of the client, and are chosen by their results."""

import json
import shutil
import tomllib
from collections import Counter
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from robot_client.cli.insert import make_plan
from robot_client.insertion.events import Begin
from robot_client.insertion.lease import Lease
from robot_client.insertion.machine import Phase, State, step
from robot_client.settings import load_settings
from service.contract.shipped import released_models
from service.contract.toml import toml_text
from simulation.cell.config import client_config
from simulation.closed_loop.job import Job
from simulation.closed_loop.play import insert, models_of
from simulation.scene.worlds import World
from simulation.studies.drawn_worlds import Start
from simulation.studies.pace.choose import Wanted, choose, settings_toml
from simulation.studies.pace.figures import figures
from simulation.studies.pace.front import beaten_by, front
from simulation.studies.pace.groups import groups
from simulation.studies.pace.kept import PARTS, kept
from simulation.studies.pace.points import BEFORE, POINTS, SHIPPED, Point, client, tasks, with_care
from simulation.studies.pace.report import pace_page, report_of

SHIPPED_CLIENT = client()
DOCS = Path(__file__).parents[3] / "docs"
FACTS = {
    "egm_guide_port": 6510,
    "rapid": {},
    "rws_url": "http://127.0.0.1:80",
    "gripper": "127.0.0.1:1000",
    "object": "rectangle",
    "approach": {"z_mm": 35.0},
    "gap_width_mm": 56.0,
    "neighbours_stay": True,
    "expected_depth_mm": 25.0,
    "creep_allowance_mm": 4.0,
    "home": {"x_mm": 0.0, "y_mm": 0.0, "z_mm": 60.0, "yaw_deg": 0.0},
}


def point(name="a", seconds=4.0, inserted=48, wrong=0, force=20.0):
    return {
        "name": name,
        "seconds_a_box": [seconds, seconds - 0.2, seconds + 0.2],
        "inserted": inserted,
        "claimed_wrongly": wrong,
        "force_n": {"95": force, "largest": force + 5.0},
        "force_95_n": [force, force - 1.0, force + 1.0],
        "client": client(10.0, 25.0),
        "needs": "",
    }


def test_every_choice_begins_from_the_same_starts_in_the_same_worlds():
    begun = [Start(World(), name, 1.0, 2.0, 1.0) for name in ("circle", "can")]
    todo = tasks(POINTS, begun, 5, Path("m"), [0.1, 0.2])
    same = ("scene", "index", "x_mm", "theta_deg", "seed", "changes", "unstated", "given_reach")
    for place in range(0, len(todo), len(POINTS)):
        mine = [{key: task.job[key] for key in same} for task in todo[place : place + len(POINTS)]]
        assert all(job == mine[0] for job in mine)
    assert len({task.key for task in todo}) == len(todo)


def test_what_ships_is_a_choice_that_was_played():
    (shipped,) = (point for point in POINTS if point.name == SHIPPED)
    settings, ours = load_settings(None, dict(shipped.client)), load_settings(None)
    assert (settings.pace, settings.ramps, settings.limits) == (ours.pace, ours.ramps, ours.limits)


def test_no_choice_is_faster_in_a_world_than_its_cameras_bear():
    slow = Start(World(changes={"camera.fps": 10.0}), "circle", 0.0, 0.0, 1.0)
    for point, late_s in product(POINTS, (None, 0.1, 0.25)):
        tables = with_care(point.client, slow.world, slow.scene, late_s)
        bears_mm_s = Lease().late_by(late_s).fastest_mm_s(10.0)
        assert tables["ramps"]["descend"]["speed_mm_s"] == min(
            point.client["ramps"]["descend"]["speed_mm_s"], bears_mm_s
        )


def test_a_start_whose_lateness_was_not_measured_is_not_played_as_no_client_would_insert_there():
    begun = [Start(World(), name, 1.0, 2.0, 1.0) for name in ("circle", "can")]
    todo = tasks(POINTS, begun, 5, Path("m"), [None, 0.1])
    assert {(task.job["scene"], task.job["late_s"]) for task in todo} == {("can", 0.1)}
    assert len(todo) == len(POINTS)


@pytest.mark.parametrize("chosen", POINTS, ids=lambda point: point.name)
def test_the_client_accepts_every_choice_with_all_its_bounds(chosen):
    plan = make_plan(load_settings(None, dict(chosen.client)), 3.0, 2.0, "t", None)
    state, _ = step(State(plan), Begin(at_s=0.0, pose=plan.approach))
    assert state.phase is Phase.GREETING


def played(seconds, force, inserted=40):
    """Forty insertions of one choice: seconds and force of each, and how many went in."""
    spread = np.random.default_rng(0).normal(size=40)
    return [
        {
            "seconds": {"all": seconds + 0.5 * float(at)},
            "course": {"force_n": force + float(at)},
            "inserted": index < inserted,
            "claimed": index < inserted,
        }
        for index, at in enumerate(spread)
    ]


def named(name, needs=""):
    return Point(name, client(), needs)


def test_a_choice_is_beaten_only_beyond_chance():
    rows = {"quick": played(4.0, 20.0), "as good": played(4.0, 20.0, 39), "slow": played(5.0, 20.0)}
    rows |= {"gentle": played(6.0, 10.0), "quickest": played(3.0, 20.0)}
    points = [*map(named, ("quick", "as good", "slow", "gentle")), named("quickest", "faster cameras")]
    beaten = beaten_by(points, rows)
    assert beaten == {"quick": [], "as good": [], "slow": ["quick", "as good"], "gentle": [], "quickest": []}
    published = [{"name": point.name, "needs": point.needs, "beaten_by": beaten[point.name]} for point in points]
    assert front(published) == {"quick", "as good", "gentle"}


def test_a_star_is_what_ships_and_nothing_else():
    shown = figures(json.loads((DOCS / "pace.json").read_text()), set())
    stars = {mark.name for panel in shown for series in panel.series for mark in series.marks if mark.ships}
    assert stars == {"as shipped", "steps of depth", "fp32"}


def test_a_start_that_the_gel_cannot_bear_takes_no_time_and_hides_none_of_the_others(tmp_path):
    """In the first start the gel is squeezed through by the grip, before anything is played."""
    soft = World("soft", {"gel.thickness_mm": 10.0, "gel.shear_modulus_n_per_mm2": 0.005})
    models, points = released_models(), [named(BEFORE), named(SHIPPED)]
    begun = [Start(world, "circle", 0.1, 0.1, 1.0) for world in (soft, World())]
    rows = [insert(Job(**task.job), models_of(models)) for task in tasks(points, begun, 5, models, [0.1, 0.1])]
    assert [row["void"] for row in rows] == [True, True, False, False]
    before, shipped = report_of([*rows[:2], *rows[2:] * 30], points)["points"]
    assert before["inserted"] == 30
    assert before["parts"] == shipped["parts"]
    assert shipped["parts"]["guarded descent"]["mean"] > 0.3


def test_a_quicker_choice_with_an_untrue_claim_beats_nobody():
    liar = played(4.0, 20.0, 30)
    for row in liar[30:]:
        row["claimed"] = True
    points = [named("liar"), named("honest")]
    assert beaten_by(points, {"liar": liar, "honest": played(5.0, 20.0)})["honest"] == []


def test_groups_hold_every_insertion_once_for_each_quantity():
    shapes = ("circle", "rectangle", "hexagon", "circle", "rectangle", "hexagon")
    more = [{"scene": name, "changes": {"camera.fps": 20.0 + 10.0 * i}} for i, name in enumerate(shapes)]
    each = groups([row | {"attempts": 1} | place for row, place in zip(played(5.0, 10.0), more, strict=False)])
    counted = Counter()
    for group in each:
        counted[group["by"]] += group["insertions"]
    assert set(counted.values()) == {6}
    assert [group["insertions"] for group in each if group["by"] == "object"] == [2, 2, 2]
    assert [group["name"] for group in each if group["by"].startswith("camera")] == ["20 to 37", "37 to 53", "53 to 70"]


def test_the_quickest_that_keeps_all_three_is_chosen_and_else_the_nearest():
    """What is kept is shown by the intervals: 45 of 50 may be 79 %, and 50 of 50 may be 93 %."""
    data = {"insertions": 50, "points": [point("slow", 6.0, 50), point("quick", 4.0, 45), point("liar", 2.0, 50, 1)]}
    asked = {(7.0, 0.9, 30.0): ("slow", True), (7.0, 0.75, 30.0): ("quick", True), (4.1, 0.75, 30.0): ("quick", False)}
    asked |= {(7.0, 0.99, 30.0): ("slow", False), (6.1, 0.9, 30.0): ("slow", False), (7.0, 0.9, 20.5): ("slow", False)}
    for wanted, answer in asked.items():
        best, kept = choose(data, Wanted(*wanted))
        assert (best["name"], kept) == answer, wanted
    liars = {"insertions": 50, "points": [point("quicker", 2.0, 50, 2), point("fewer", 9.0, 50, 1)]}
    assert choose(liars, Wanted(10.0, 0.9, 30.0)) == (liars["points"][1], False)
    with pytest.raises(ValueError, match="expected seconds"):
        Wanted(-1.0, 0.9, 30.0).check()


def test_settings_that_were_chosen_are_a_configuration_of_the_client(tmp_path):
    text = settings_toml(point(), 48)
    file = tmp_path / "cell.toml"
    file.write_text(client_config(FACTS, "http://127.0.0.1:1", None, chosen=tomllib.loads(text)))
    played = load_settings(file)
    with_these = {
        key: value for key, value in tomllib.loads(file.read_text()).items() if key not in tomllib.loads(text)
    }
    file.write_text(toml_text(with_these) + "\n" + text)  # as an integrator does: the file's own text
    settings = load_settings(file)
    assert settings == played
    assert (settings.pace.fast_mm_s, settings.ramps.descend.speed_mm_s) == (25.0, 10.0)


def test_seconds_in_lock_step_add_up_and_what_ships_is_slow_only_around_the_tops():
    models = models_of(released_models())
    play = {
        chosen.name: insert(Job("circle", 0, 0.1, 0.1, 5, "belief", "fields", client=chosen.client), models)
        for chosen in POINTS
        if chosen.name in {BEFORE, SHIPPED}
    }
    before, shipped = play[BEFORE], play[SHIPPED]
    assert before["inserted"]
    assert shipped["inserted"]
    assert before["attempts"] == shipped["attempts"] == 1
    assert before["seconds"]["guarded descent"] == pytest.approx(2.7, abs=0.15)  # 25 mm at 10 mm/s, and a ramp
    assert before["seconds"]["fast descent"] == 0.0
    assert shipped["seconds"]["fast descent"] == pytest.approx(2.0, abs=0.3)
    slow_mm_s = SHIPPED_CLIENT["ramps"]["descend"]["speed_mm_s"]
    assert shipped["seconds"]["guarded descent"] == pytest.approx(6.0 / slow_mm_s, abs=0.3)  # the band is 6 mm high


def test_the_page_counts_false_claims_among_claims():
    data = json.loads((DOCS / "pace.json").read_text())
    data["points"] = [row | {"inserted": 90, "claimed_wrongly": 0, "untrue": []} for row in data["points"]]
    data["points"][0] |= {"claimed_wrongly": 1, "untrue": [[7, "it is tilted"]]}
    text = " ".join(pace_page(data).split())
    assert f"1 of {90 * len(data['points']) + 1} claims were false" in text
    assert "**False claims: 1.** Start 7, before: it is tilted." in text


@pytest.mark.parametrize("started", [("fp32", "int8 blocked"), ("fp32",)])
def test_a_build_that_this_processor_refuses_is_left_out(tmp_path, started):
    for part in PARTS:
        shutil.copy(DOCS / f"{part}.json", tmp_path)
    bench = json.loads((tmp_path / "benchmark.json").read_text())
    refused = {"precision": "int8 static", "refused": "its answers differ"}
    bench["int8"] = [row for row in bench["int8"] if row["precision"] in started] + [refused]
    (tmp_path / "benchmark.json").write_text(json.dumps(bench))
    data = json.loads((DOCS / "pace.json").read_text()) | {"kept": kept(tmp_path)}
    assert [build["name"] for build in data["kept"]["builds"]] == list(started)
    assert ("does not start here" in pace_page(data)) == (len(started) == 1)


def test_what_the_page_shows_of_others_is_what_they_say_today():
    assert json.loads((DOCS / "pace.json").read_text())["kept"] == kept(DOCS)
