"""A commissioning that goes on with a record: only of its object, at its height, and with its gels."""

import asyncio
import contextlib

import pytest

from robot_client.cli import commission as cli
from robot_client.cli.commission import Probing, _commission
from robot_client.cli.terminal import printed
from robot_client.ports import DriverError
from robot_client.session.commission.record import RECORD, Record, keep_record
from robot_client.session.commission.taught import CELL
from robot_client.settings import SettingsError, Task
from service.contract.frames import ContractError
from tests.robot_client.cli.test_probing import REAL
from tests.robot_client.insertion.stories import hello, service
from tests.robot_client.session.test_commission import camera
from tests.robot_client.session.test_lateness import series_of
from tests.robot_client.session.test_wiring import answers


@pytest.mark.parametrize(
    ("changed", "signs_n", "says"),
    [
        ({"object": "tin"}, 4, "begun with task.object = 'soap', which is 'tin' now: set it back, or name another"),
        ({"approach_z_mm": 33.0}, 1, "task.approach_z_mm = 35, which is 33 now, and its 4 signs are not complete"),
        ({"approach_z_mm": 33.0}, 4, None),
        ({}, 1, None),
    ],
)
def test_a_record_goes_on_with_its_object_and_until_the_signs_are_complete_at_its_height(
    tmp_path, monkeypatch, changed, signs_n, says
):
    """Else the second object, or the height of the second day, would be taught from what the first was."""
    began, record = [], Record(begun="today", seed=0, object="soap", approach_z_mm=35.0)
    keep_record(tmp_path / RECORD, record.model_copy(update={"signs": tuple(answers())[:signs_n]}))

    async def begins(*asked):
        began.append(asked)

    monkeypatch.setattr(cli, "_commission", begins)
    settings = REAL.model_copy(update={"task": Task(**{"object": "soap", "approach_z_mm": 35.0} | changed)})
    with pytest.raises(SettingsError, match=says) if says else contextlib.nullcontext():
        cli.commission(settings, live=True, probes_n=8, seed=0, out=tmp_path, one_grip=True)
    assert bool(began) == (says is None)


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize(("stay", "warned"), [(False, True), (True, False)])
def test_neighbours_that_may_slide_are_to_be_fixed_before_anything_moves(
    tmp_path, monkeypatch, capsys, live, stay, warned
):
    """Each press may push them, and the gap with them, away from where the errors are counted."""
    printed = []

    async def begins(*_asked):
        printed.append(capsys.readouterr().out)

    monkeypatch.setattr(cli, "_commission", begins)
    settings = REAL.model_copy(update={"task": Task(neighbours_stay=stay)})
    cli.commission(settings, live=live, probes_n=8, seed=0, out=tmp_path, one_grip=True)
    lines = " ".join("".join([*printed, capsys.readouterr().out]).split())
    assert len(printed) == live
    assert ("task.neighbours_stay is not true: fix the neighbours for the commissioning" in lines) == warned


@pytest.mark.parametrize("damage", [lambda text: text[:40], lambda text: text.replace("seed = 0", "seed = 1")])
def test_a_damaged_record_is_refused_until_its_folder_is_moved_away_as_it_says(tmp_path, damage):
    path = tmp_path / "commissioning" / RECORD
    keep_record(path, Record(begun="today", seed=0))
    path.write_text(damage(path.read_text()))
    with pytest.raises(ContractError, match="move its folder away and commission the cell again"):
        cli.commission(REAL, live=False, probes_n=8, seed=0, out=path.parent, one_grip=True)
    path.parent.rename(tmp_path / "away")
    assert cli.commission(REAL, live=False, probes_n=8, seed=0, out=path.parent, one_grip=True).done


def moves(monkeypatch, gel):
    """Whatever begins to move, in a cell whose service answers with a left gel."""
    began = []

    class Link:
        def __init__(self, *_about):
            pass

        async def start(self, post):
            self.post = post

        def send(self, _hello):
            self.post(service(hello(cameras=(camera(gel),))))

        async def close(self):
            pass

    async def begin(_probing):
        began.append(True)
        raise DriverError("so far")

    monkeypatch.setattr("robot_client.cli.check.ServiceLink", Link)
    monkeypatch.setattr(Probing, "begin", begin)
    return began


@pytest.mark.parametrize(("gel", "begins"), [("a", True), ("z", False)])
def test_a_whole_record_of_other_gels_is_not_taken_for_theirs(tmp_path, monkeypatch, gel, begins):
    """`insert` refuses it and says to commission again, where no probe would be left to make."""
    began, commissioned = moves(monkeypatch, gel), {"left": "a"}
    record = Record(begun="today", seed=0, signs=tuple(answers()), gels=commissioned)
    ended = asyncio.run(_commission(Probing(REAL, REAL.cycle, tmp_path), 4, tmp_path / RECORD, record, [None]))
    assert (bool(began), ended.done) == (begins, False)
    assert begins or "a gel was changed or calibrated again" in ended.result["reason"]


def complete(tmp_path, **but):
    """A record of twelve probes at two grips, with the lateness."""
    signs = tuple(answers())
    timed = tuple(series_of(0.05))
    record = Record(
        begun="2026-01-01", seed=0, gels={"left": "a"}, signs=signs, timed=timed, presses=signs, probes=signs
    )
    keep_record(tmp_path / RECORD, record.model_copy(update=but))


def test_a_complete_record_is_not_probed_again_and_says_what_to_do_after_a_change(tmp_path, monkeypatch, capsys):
    """Another tool or frame may have reversed the signs, and nothing would notice."""
    complete(tmp_path)
    began, advice = (
        moves(monkeypatch, "a"),
        "if tool, frame or camera mount has changed, move its folder away and",
    )
    asked = {"probes_n": 12, "seed": 0, "out": tmp_path, "one_grip": False}
    (step,) = cli.commission(REAL, live=False, **asked).result["steps"]
    assert step.startswith(f"probe nothing: the record of 2026-01-01 in {tmp_path / RECORD} is complete; {advice}")
    capsys.readouterr()
    assert cli.commission(REAL, live=True, **asked).done
    lines = " ".join(capsys.readouterr().out.split())
    assert "will: probe nothing: the record of 2026-01-01" in lines
    assert advice in lines
    assert "neighbours" not in lines, "nothing presses"
    assert not began, "nor do the fingers open"
    (tmp_path / CELL).unlink()
    assert cli.commission(REAL, live=True, **asked).done
    assert (tmp_path / CELL).is_file(), "but what a kill has left out is written"


def test_a_record_is_complete_with_the_grips_that_gripper_and_networks_allow(tmp_path, monkeypatch, capsys):
    complete(tmp_path, presses=tuple(answers())[:2], probes=tuple(answers()) * 2)
    began = moves(monkeypatch, "a")

    async def allowed(_probing, grips_n):
        return grips_n[:1]

    monkeypatch.setattr(Probing, "allowed", allowed)
    assert cli.commission(REAL, live=True, probes_n=14, seed=0, out=tmp_path, one_grip=False).done
    assert not began
    printed()
    assert "--outruns/adapted_2026-01-01" in "".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("but", "probes_n", "left"),
    [
        ({}, 20, ["8 more probes"]),
        ({"probes": ()}, 10, ["2 more probes"]),
        ({"timed": (), "probes": ()}, 8, ["press 7 to 13 times"]),
        (
            {"presses": tuple(answers())[:3]},
            13,
            ["press at +0 mm -15 deg until the gel slides, at 20 N", "1 more probes"],
        ),
        (
            {"signs": tuple(answers())[:3], "timed": (), "presses": (), "probes": ()},
            8,
            [
                "probe at -8 mm +8 deg: are the signs right?",
                "press 7 to 13 times",
                "press at +0 mm +15 deg, +0 mm -15 deg until the gel slides, at 40 N",
                "press at +0 mm +15 deg, +0 mm -15 deg until the gel slides, at 20 N",
            ],
        ),
    ],
)
def test_only_what_a_record_lacks_is_listed(tmp_path, but, probes_n, left):
    complete(tmp_path, **but)
    goes_on, regrasps, *steps, keeps = cli.commission(
        REAL, live=False, probes_n=probes_n, seed=0, out=tmp_path, one_grip=False
    ).result["steps"]
    assert goes_on.startswith("go on with the record of 2026-01-01; if tool, frame or camera mount has changed")
    assert (regrasps[:8], keeps[:4]) == ("regrasp ", "keep")
    assert [step[: len(start)] for step, start in zip(steps, left, strict=True)] == left
