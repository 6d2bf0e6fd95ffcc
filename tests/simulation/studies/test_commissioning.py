"""A cell's wiring is checked before it learns, and a row has the same fields for every cell."""

import json
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from service.contract import ContractError
from simulation.cli.commission import Options, _cell
from simulation.closed_loop.statistics import Row
from simulation.scene.worlds import World, load_objects
from simulation.studies import commissioning
from simulation.studies.commissioning import COUNTED, VERSIONS, Cell, Plan, commission
from simulation.studies.commissioning_page import commissioning_page
from simulation.studies.wiring import MISTAKES, mistaken
from tests.simulation.data.test_sources import as_if_changed

OBJECTS = ("rectangle", "circle")
DOCS = Path(__file__).parents[3] / "docs"


def asked_for_signs(world: World, tmp_path) -> Row:
    from service.contract.shipped import released_models

    objects = {name: world.around(scene) for name, scene in load_objects(OBJECTS).items()}
    plan = Plan(released_models() / "checkpoint.pt", released_models(), 0, 1, workers=1)
    return commission(Cell(world, objects, tmp_path / world.name, 3), plan)


@pytest.mark.slow
@pytest.mark.parametrize("world", [World("good"), *mistaken(World("good"))], ids=lambda world: world.name)
def test_a_mistake_of_a_first_day_is_named_and_a_good_cell_is_not(world, tmp_path):
    row = asked_for_signs(world, tmp_path)
    (named,) = row["mistakes_named"] or [""]
    wants = {"good": "", "left mirrored": "mirrored", "right mirrored": "mirrored", "x reversed": "x reach the arm"}
    wants |= {"fingers swapped": "swapped", "both mirrored": "both pictures", "yaw reversed": "yaw reach the arm"}
    want = wants[world.name.rpartition(", ")[2]]
    assert want in named
    assert bool(want) == bool(named)
    assert all(set(row[version]) == set(COUNTED) for version in VERSIONS)
    assert json.loads(json.dumps(row))["robot_minutes"] > 0.5


def test_probes_are_drawn_within_what_the_object_may_be_off_and_none_where_it_fits(tmp_path):
    cell, places = Cell(World(), load_objects(OBJECTS), tmp_path, 1), set()
    for job in cell.probes(60):
        scene = cell.objects[job["scene"]]
        for x_mm, theta_deg in [(job["x_mm"], job["theta_deg"]), *job["starts"]]:
            assert abs(x_mm) <= scene.x_range_mm
            assert abs(theta_deg) <= scene.theta_range_deg
            assert abs(x_mm) > 2.5 or abs(theta_deg) > 3.0
            places.add((x_mm, theta_deg))
    assert len(places) == 60
    assert len({job["seed"] for job in [*cell.probes(60), *cell.jobs(60, 3), *next(cell.signs())]}) == 13 + 64
    assert len(MISTAKES) == 6


def test_a_grasp_of_few_probes_that_ends_late_takes_no_place_of_another(tmp_path, monkeypatch):
    """Workers end in any order, and later calls find what is done in another one."""
    cell = Cell(World("good"), load_objects(OBJECTS), tmp_path, 1)
    plan, learnt = Plan(tmp_path, tmp_path, 150, 1), {}

    def played(_play, episodes, _workers, *, in_order):
        rows = [{**one.job, "robot_s": 1.0} for one in episodes]
        return rows if in_order else sorted(rows, key=lambda row: -len(row["starts"]))

    signs = [{"robot_s": 1.0}] * 4
    monkeypatch.setattr(commissioning, "results", played)
    monkeypatch.setattr(commissioning, "_asked_for_signs", lambda *_: (signs, tmp_path / "signs-1"))
    monkeypatch.setattr(commissioning, "named_mistakes", lambda _: [])
    monkeypatch.setattr(commissioning, "carried_out", lambda _: True)
    monkeypatch.setattr(commissioning, "timed", lambda *_, **__: {"late_s": 0.1, "robot_s": 600.0})
    monkeypatch.setattr(commissioning, "_scored", lambda *_: {})

    def adapted(_cell, _plan, name, episodes, _around):
        learnt[name] = [folder.name for folder in episodes if folder.parent.name == "probes"]
        return {"took_s": 1.0, "accepted": False}, None

    monkeypatch.setattr(commissioning, "_adapted", adapted)
    row = commission(cell, plan)
    assert row["robot_minutes"] == pytest.approx((4 + len(cell.probes(146)) + 600) / 60), (
        "timing presses take time, too"
    )
    few = next(index for index, job in enumerate(cell.probes(146)) if len(job["starts"]) == 0)
    assert learnt["after_50"] == [f"{index:05d}" for index in range(few + 1)]


def test_few_probes_are_those_of_the_wiring_and_as_many_more(tmp_path):
    cell = Cell(World(), load_objects(OBJECTS), tmp_path, 1)
    assert [sum(1 + len(job["starts"]) for job in cell.probes(count)) for count in range(7)] == [*range(7)]


@pytest.mark.parametrize(("probes", "few", "all_"), [(20, 20, None), (50, 50, None), (63, 50, 63), (150, 50, 150)])
def test_the_first_lesson_has_fifty_probes_and_splits_no_grasp(tmp_path, probes, few, all_):
    cell, plan = Cell(World(), load_objects(OBJECTS), tmp_path, 1), Plan(tmp_path, tmp_path, probes, 1)
    labelled = {tmp_path / f"sign-{index}": 1 for index in range(4)}
    labelled |= {tmp_path / f"{n}": 1 + len(job["starts"]) for n, job in enumerate(cell.probes(probes - 4))}
    made = {
        name: sum(map(labelled.get, lesson)) for name, lesson in commissioning._lessons(cell, plan, labelled).items()
    }
    assert made == {"after_50": few, **({"after_150": all_} if all_ else {})}


def test_each_world_begins_from_starts_of_its_own_so_that_those_of_all_worlds_can_be_counted_together(tmp_path):
    options = Options((), OBJECTS, tmp_path / "rows.json")
    cells = [_cell(options, World(name), "code") for name in ("one", "other", "one")]
    starts = [
        {(job["x_mm"], job["theta_deg"]) for job in (*cell.jobs(8, 3), *cell.probes(8))}
        | {job["seed"] for job in (*cell.jobs(8, 3), *next(cell.signs()))}
        for cell in cells
    ]
    assert starts[0] == starts[2]
    assert starts[0].isdisjoint(starts[1])


@pytest.mark.parametrize(
    ("first", "second", "asked"),
    [
        ("in", "touched", "signs-2"),
        ("not held", "touched", "signs-2"),
        ("in", "in", "signs-1"),
        ("in", "not held", "signs-1"),
        ("not held", "in", "signs-2"),
    ],
)
def test_the_signs_are_those_of_the_first_object_that_touches_something(tmp_path, monkeypatch, first, second, asked):
    row = {"in": {"reason": "", "trials": []}, "not held": {"reason": "service: refused", "trials": []}}
    row["touched"] = {"reason": "", "trials": [{}]}
    ends = {"signs-1": first, "signs-2": second}
    monkeypatch.setattr(commissioning, "_played", lambda _cell, _plan, name, jobs, **_: [row[ends[name]]] * len(jobs))
    cell = Cell(World(), load_objects(OBJECTS), tmp_path, 1)
    signs, folder = commissioning._asked_for_signs(cell, Plan(tmp_path, tmp_path, 0, 1))
    assert (signs, folder) == ([row[ends[asked]]] * 4, tmp_path / asked)


def test_what_follows_the_signs_reckons_with_the_lateness_that_the_presses_tell(tmp_path, monkeypatch):
    jobs = {}

    def played(_cell, _plan, name, todo, **_):
        jobs[name] = list(todo)
        if name == "probes":
            raise InterruptedError("enough")
        return [{"reason": "", "trials": [{"decision": {"estimate": {}}}], "robot_s": 1.0}] * len(todo)

    monkeypatch.setattr(commissioning, "_played", played)
    monkeypatch.setattr(commissioning, "named_mistakes", lambda _: [])
    monkeypatch.setattr(commissioning, "timed", lambda *_, **__: {"late_s": 0.3, "robot_s": 60.0})
    with pytest.raises(InterruptedError, match="enough"):
        commission(Cell(World(), load_objects(OBJECTS), tmp_path, 1), Plan(tmp_path, tmp_path, 20, 1))
    assert {job["late_s"] for job in jobs["signs-1"]} == {None}
    assert {job["late_s"] for job in jobs["probes"]} == {0.3}
    (probing_mm_s,) = {job["client"]["ramps"]["descend"]["speed_mm_s"] for job in jobs["probes"]}
    assert probing_mm_s * 0.3 < 1.5
    assert probing_mm_s < jobs["signs-1"][0]["client"]["ramps"]["descend"]["speed_mm_s"]


def test_the_page_bears_a_run_that_only_asked_for_signs():
    named = {"good": [], "good, x reversed": ["corrections in x reach the arm reversed"]}
    rows = [
        {"world": world, "mistakes_named": causes, "signs_told": True, "verdicts": {}}
        for world, causes in named.items()
    ]
    late = [{"late_s": late_s, "true_late_s": 0.08, "robot_s": 30.2} for late_s in (0.07, 0.14, None)]
    text = commissioning_page({"note": "", "rows": rows, "late": late})
    prose = " ".join(text.split())
    assert "a bound on them in 2: +25 ms from the truth on average, -10 to +60 ms, and below it in 50 %" in prose
    assert "0 of 1 good cells were accused" in text
    assert "1 of 1 mistakes were named" in text
    untimed = commissioning_page({"note": "", "rows": rows, "late": late[2:]})
    assert "In none of 1 worlds did presses at two speeds" in untimed


def test_insertions_of_a_cell_that_presses_could_not_time_do_not_count():
    """`insert` refuses there."""
    rows = [row for row in json.loads((DOCS / "commissioning.json").read_text())["rows"] if row.get("late")]
    timed = [row for row in rows if row["late"]["late_s"] is not None][:2]
    untimed = {**timed[1], "world": "untimed", "robot_minutes": 99.0, "late": {**timed[1]["late"], "late_s": None}}
    before, after = (commissioning_page({"note": "", "rows": rows}) for rows in (timed, [*timed, untimed]))
    pooled = next(line for line in before.splitlines() if line.startswith("| released | "))
    assert pooled in after.splitlines()
    assert "Insertions in 1 of 3 worlds do not count" in after
    assert "at most 99.0 min of robot time" in after, "it was probed all the same"


def test_a_world_whose_file_states_a_mistake_is_no_good_cell_that_was_accused():
    row = {"mistakes_named": ["the fingers are swapped"], "signs_told": True, "verdicts": {}, "wired_right": False}
    text = commissioning_page({"note": "", "rows": [{"world": "swapped", **row}]})
    assert "0 of 0 good cells were accused" in text
    assert "1 worlds whose own file states a mistake are left out." in text


def test_an_adapted_network_that_cannot_be_exported_is_refused_and_the_cell_goes_on(tmp_path, monkeypatch):
    from service.contract.shipped import released_models
    from training.fit.checkpoint import Checkpoint

    unvalidated = replace(Checkpoint.load(released_models() / "checkpoint.pt"), figures={})
    call = commissioning._call

    def adapt_accepts(package: str, *words: str) -> str:
        if package == "export":
            return call(package, *words)
        options = dict(pairwise(words))
        unvalidated.save(Path(options["--out"]) / "checkpoint.pt")
        Path(options["--json"]).write_text(json.dumps({"accepted": True, "best": "all", "objections": []}))
        return ""

    monkeypatch.setattr(commissioning, "_call", adapt_accepts)
    cell = Cell(World("cell"), load_objects(OBJECTS), tmp_path / "cell", 3)
    plan = Plan(released_models() / "checkpoint.pt", released_models(), 0, 1, workers=1)
    outcome, models = commissioning._adapted(cell, plan, "after_50", [], None)
    assert models is None
    assert not outcome["accepted"]
    assert "never validated" in outcome["objections"][0]


def episodes(folder: Path, count: int) -> list[Path]:
    """Stored probes that hold nothing to learn from."""
    summary = {"purpose": "probe", "outcome": "failed", "approach": {"x_mm": 5.0, "yaw_deg": 4.0}}
    listed = [folder / f"{index:05d}" for index in range(count)]
    for each in listed:
        each.mkdir(parents=True)
        (each / "summary.json").write_text(json.dumps({**summary, "count": count}))
    return listed


def test_a_verdict_is_kept_for_its_episodes_and_its_release_only(tmp_path):
    from service.contract.shipped import released_models

    cell = Cell(World("cell"), load_objects(OBJECTS), tmp_path / "cell", 3)
    plan = Plan(released_models() / "checkpoint.pt", released_models(), 0, 1, workers=1)
    (other := tmp_path / "other.pt").write_bytes(b"no checkpoint")

    def objection(plan: Plan, from_these: list[Path]) -> str:
        outcome, _ = commissioning._adapted(cell, plan, "after_50", from_these, None)
        return str(outcome["objections"][0])

    one, two = episodes(tmp_path / "one", 1), episodes(tmp_path / "two", 2)
    first = objection(plan, one)
    assert "other.pt" in objection(replace(plan, checkpoint=other), one)
    objection(plan, two)
    assert objection(plan, one) == first
    assert len(list(cell.folder.glob("after_50-*/verdict.json"))) == 3


def test_a_verdict_is_made_again_where_the_code_that_adapts_or_exports_has_changed(tmp_path, monkeypatch):
    asked = list[str]()
    monkeypatch.setattr(commissioning, "_call", lambda package, *_: asked.append(package) or "refused")
    (checkpoint := tmp_path / "checkpoint.pt").write_bytes(b"a release")
    cell, plan = Cell(World("cell"), load_objects(OBJECTS), tmp_path, 3), Plan(checkpoint, tmp_path, 0, 1, workers=1)
    learnt_from = episodes(tmp_path / "probes", 1)
    for file in ("", "training/adapt/objections.py", "training/fit/train.py", "export/onnx/to_onnx.py"):
        with monkeypatch.context() as patch:
            if file:
                as_if_changed(patch, file)
            for _ in range(2):
                commissioning._adapted(cell, plan, "after_50", learnt_from, None)
    assert asked == ["training"] * 4


def test_presses_around_a_cell_are_kept_for_their_number_and_objects_only(tmp_path):
    from simulation.data.manifest import read_manifest

    objects = load_objects(OBJECTS)
    cell = Cell(World("cell"), {"circle": objects["circle"]}, tmp_path / "cell", 3)
    plan = Plan(tmp_path, tmp_path, 0, 1, workers=1, around=1)
    one, took_s = commissioning._pressed_around(cell, plan)
    two, _ = commissioning._pressed_around(cell, replace(plan, around=2))
    other, _ = commissioning._pressed_around(replace(cell, objects={"rectangle": objects["rectangle"]}), plan)
    assert [read_manifest(folder).trials for folder in (one, two, other)] == [1, 2, 1]
    assert list(read_manifest(other).scenes) == ["rectangle"]
    assert commissioning._pressed_around(cell, plan) == (one, took_s)


def test_of_grips_and_heights_only_what_all_objects_share_is_taken_as_known_of_a_cell(tmp_path):
    objects = load_objects(["circle", "rectangle"])
    low = objects["circle"].model_copy(update={"grasp": objects["circle"].grasp.model_copy(update={"height_mm": 40.0})})
    cell = Cell(World("cell"), objects | {"circle": low}, tmp_path / "cell", 3)
    folder, _ = commissioning._pressed_around(cell, Plan(tmp_path, tmp_path, 0, 1, workers=1, around=2))
    known = tomllib.loads(folder.with_suffix(".toml").read_text())
    assert known["grasp"] == {"force_n": objects["rectangle"].grasp.force_n}


def test_a_cell_with_an_object_that_cannot_be_pressed_learns_from_no_presses_and_goes_on(tmp_path, capsys):
    (tmp_path / "anvil.toml").write_text(
        '[object]\nshape = "rectangle"\nsize_x_mm = 60.0\nsize_y_mm = 50.0\nmass_kg = 5.0\n'
    )
    objects = load_objects(["circle", str(tmp_path / "anvil.toml")])
    plan = Plan(tmp_path, tmp_path, 0, 1, workers=1, around=2)
    assert commissioning._pressed_around(Cell(World("cell"), objects, tmp_path / "cell", 3), plan)[0] is None
    assert "cell: nothing is learnt from presses" in (shown := capsys.readouterr().err)
    assert "grasp_lost" in shown


def test_a_command_that_gives_no_answer_ends_the_run(monkeypatch):
    monkeypatch.setitem(commissioning.ANSWERS, "simulation", {0})
    with pytest.raises(ContractError, match=r"simulation teapot: exit status 2: .*teapot"):
        commissioning._call("simulation", "teapot")
