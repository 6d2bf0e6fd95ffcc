"""What a commissioning teaches of the gap: a configuration for `insert`, beside the record."""

import asyncio
from functools import partial

import pytest

from robot_client.cli.commission import Probing, _commission
from robot_client.cli.insert import with_commissioning
from robot_client.session.commission.record import RECORD, Record, read_record
from robot_client.session.commission.run import Ended
from robot_client.session.commission.taught import CELL, lower_mm, teach
from robot_client.settings import load_settings
from tests.full_disk import fill_before
from tests.robot_client.insertion.stories import PLAN
from tests.robot_client.session.test_commission import Cell
from tests.robot_client.session.test_lateness import pressed, series_of
from tests.robot_client.session.test_several_probes import Losing
from tests.robot_client.session.test_wiring import answers

GIVEN = """
[robot.rws]
url = "http://127.0.0.1:8080"
user = "cell"

[gripper]
force_limit_n = 30.0

[task]
object = "soap"
gap_width_mm = 58.0
expected_depth_mm = 24.0

[cycle]
open_mm = 80.0
pick = {x_mm = -20.0, y_mm = 5.0, z_mm = 45.0, yaw_deg = 0.0}
"""
PROBING_MM_S, LATE_S, OPEN_S = 5.0, 0.1, 0.03


@pytest.fixture
def given(tmp_path, monkeypatch):
    """The settings of a cell whose password is in the environment."""
    monkeypatch.setenv("TACTILE_INSERTION_RWS_PASSWORD", "secret")
    (tmp_path / "given.toml").write_text(GIVEN)
    return load_settings(tmp_path / "given.toml")


def record_of(below_mm, late=LATE_S):
    timed = tuple(series_of(late - OPEN_S, frame_s=0.0)) if late else ()
    probes = zip(answers(), below_mm, strict=True)
    signs = tuple(
        probe.model_copy(update={"below_mm": below, "touch_mm_s": None if below is None else PROBING_MM_S})
        for probe, below in probes
    )
    return Record(begun="today", seed=1, object="soap", approach_z_mm=35.0, signs=signs, timed=timed)


@pytest.mark.parametrize(
    ("below_mm", "late", "z_mm", "says"),
    [
        ((1.5, 1.9, 1.6, 1.8), LATE_S, 33.8, "1.2 mm lower than taught: task.approach_z_mm 35 -> 33.8"),
        ((-0.6, None, None, -0.8), LATE_S, 36.2, "1.2 mm higher than taught: task.approach_z_mm 35 -> 36.2"),
        ((0.9, 0.9, 0.9, 0.9), LATE_S, 35.0, "0.4 mm lower than taught, as good as taught"),
        ((1.7, None, None, None), LATE_S, 35.0, "not felt"),
        ((1.5, 1.9, 1.6, 1.8), None, 35.0, "not felt"),
    ],
)
def test_the_approach_follows_the_tops_that_were_touched_less_what_is_late(tmp_path, given, below_mm, late, z_mm, says):
    path = tmp_path / RECORD
    assert says in teach(given.tables(), record_of(below_mm, late), path)
    assert load_settings(tmp_path / CELL).task.approach_z_mm == z_mm


def test_each_touch_is_less_what_is_late_at_its_own_speed():
    """A cell that was told to descend more slowly was touched faster, and so was one met above the slow band."""
    record, kept = record_of((1.5, 1.5, 1.0, 1.0)), []
    for probe, touch_mm_s in zip(record.signs, (10.0, 10.0, 5.0, 5.0), strict=True):
        kept.append(probe.model_copy(update={"touch_mm_s": touch_mm_s}))
    assert lower_mm(record.model_copy(update={"signs": tuple(kept)})) == pytest.approx(0.5)


def test_the_taught_file_is_the_given_one_with_the_record_and_without_the_password(tmp_path, given, monkeypatch):
    path = tmp_path / RECORD
    teach(given.tables(), record_of((1.5, 1.9, 1.6, 1.8)), path)
    task = given.task.model_copy(update={"approach_z_mm": 33.8})
    assert load_settings(tmp_path / CELL) == given.model_copy(update={"task": task, "commissioning": path})
    assert not [word for word in ("secret", "password =") if word in (tmp_path / CELL).read_text()]
    monkeypatch.delenv("TACTILE_INSERTION_RWS_PASSWORD")
    assert load_settings(tmp_path / CELL).robot.rws.user == "cell"


def test_who_goes_on_with_the_taught_file_does_not_teach_it_twice(tmp_path, given):
    path, record = tmp_path / RECORD, record_of((1.5, 1.9, 1.6, 1.8))
    teach(given.tables(), record, path)
    first = load_settings(tmp_path / CELL)
    teach(first.tables(), record, path)
    assert load_settings(tmp_path / CELL) == first


class Taught(Cell):
    """A cell of whose blocks each probe touches the tops 2 mm lower than taught, and that is hardly late."""

    async def probe(self, x_mm, theta_deg):
        ended = await super().probe(x_mm, theta_deg)
        below = {"below_mm": 2.0, "touch_mm_s": PROBING_MM_S}
        return ended._replace(probes=tuple(probe.model_copy(update=below) for probe in ended.probes))

    async def press_at(self, x_mm, theta_deg, fast):
        ended: Ended = await self.probe(x_mm, theta_deg)
        return ended._replace(stop=pressed(fast, 6.0, 0.0, frame_s=0.0).stop)


def commissioned_by(cell, given, path, monkeypatch, probes_n=6):
    async def gives(*_, answer=None, **_how):
        return answer

    probing = Probing(given, given.cycle, path.parent)
    fakes = {"begin": gives, "leave": gives, "allowed": partial(gives, answer=[None]), "fetch": cell.fetch}
    fakes |= {"probe": cell.probe, "several": cell.several, "press_at": cell.press_at}
    fakes |= {"press": lambda _grip_n, *place: cell.probe(*place)}
    for name, fake in {**fakes, "picture": partial(gives, answer="<svg/>")}.items():
        monkeypatch.setattr(probing, name, fake)
    record = Record(begun="today", seed=1, object="soap", approach_z_mm=35.0)
    return asyncio.run(_commission(probing, probes_n, path, record, [None]))


@pytest.mark.parametrize("sign", [1, -1])
def test_insert_reads_what_a_commissioning_has_taught_and_one_with_mistakes_teaches_nothing(
    tmp_path, given, monkeypatch, sign
):
    path = tmp_path / "out" / RECORD
    assert commissioned_by(Taught(sign=sign), given, path, monkeypatch).done == (sign > 0)
    assert path.with_name(CELL).exists() == (sign > 0)
    if sign > 0:
        taught = load_settings(path.with_name(CELL))
        assert with_commissioning(taught, PLAN, asked=True).gels == {"left": "a", "right": "b"}
        assert taught.task.approach_z_mm == pytest.approx(35.0 - 2.0 + PROBING_MM_S * OPEN_S, abs=0.06)


def test_a_disk_that_takes_no_taught_file_holds_the_cell_and_leaves_the_record(tmp_path, given, monkeypatch):
    path, lines = tmp_path / RECORD, []
    monkeypatch.setattr("robot_client.cli.commission.show", lines.append)
    fill_before(tmp_path / CELL)
    ended = commissioned_by(Taught(), given, path, monkeypatch, probes_n=8)
    assert not ended.done
    assert [line for line in lines if line.startswith("HOLD")] == [
        f"HOLD  cannot write {path.with_name(CELL)}: No space left on device"
    ]
    assert read_record(path).done_n == 8


class Blinking(Losing, Taught):
    """Its cameras lose frames in every probe to learn from."""


def test_a_commissioning_tells_how_many_attempts_it_lost_and_what_loses_fewer(tmp_path, given, monkeypatch):
    lines = []
    monkeypatch.setattr("robot_client.cli.commission.show", lines.append)
    ended = commissioned_by(Blinking(range(1000)), given, tmp_path / RECORD, monkeypatch, probes_n=11)
    assert "nothing is learnt in 3 grasps in a row: stale" in ended.result["reason"]
    assert [line.split()[0] for line in lines if "attempts told nothing" in line] == ["15"]
    assert any("slower [ramps.descend] speed_mm_s" in line for line in lines)
