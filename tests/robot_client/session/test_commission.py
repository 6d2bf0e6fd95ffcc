"""Commissioning: probes end above the gap, an interruption loses one at most, and a record is of one cell."""

import asyncio
import contextlib
import subprocess
import sys
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import REFUSED, Phase, State
from robot_client.ports import DriverError
from robot_client.session.commission import run as commission_run
from robot_client.session.commission.answers import Answered
from robot_client.session.commission.record import Record, keep_record, read_record
from robot_client.session.commission.run import PRESSES, Commissioning, Ended, errors
from robot_client.session.commission.wiring import SIDES, probe_of
from service.contract import wire
from service.contract.frames import ContractError
from service.contract.words.wiring import WIRINGS
from tests.full_disk import fill_before
from tests.robot_client.insertion.stories import (
    PLAN,
    TO_ARMING,
    hello,
    no_decision,
    run,
    service,
)
from tests.robot_client.session.test_wiring import felt


@given(st.integers(0, 2**31), st.integers(0, 500))
def test_no_probe_begins_where_the_object_fits_or_beyond_what_is_asked_for(seed, number):
    x, theta = errors(seed, 15.0, 15.0, (2.5, 3.0))(number)
    assert max(abs(x), abs(theta)) <= 15.0
    assert abs(x) > 2.5 or abs(theta) > 3.0
    assert errors(seed, 15.0, 15.0, (2.5, 3.0))(number) == (x, theta)


class Cell:
    """Probes that answer with a share of the truth; ``fails_at`` is the one that the arm fails in, and how."""

    def __init__(self, fails_at=None, sign=1, reason="arm: tilt"):
        self.probed, self.fetched_n, self.fails_at, self.sign, self.reason = [], 0, fails_at, sign, reason
        self.gels = {"left": "a", "right": "b"}

    async def probe(self, x_mm, theta_deg):
        return await Cell.several(self, [(x_mm, theta_deg)], lambda _: None)

    async def several(self, places, answered):
        probes = []
        for x_mm, theta_deg in places:
            self.probed.append((x_mm, theta_deg))
            if len(self.probed) == self.fails_at:
                return Ended(tuple(probes), Phase.FAILED, self.reason, self.gels)
            pose = WorkPose(x_mm=x_mm, y_mm=0.0, z_mm=35.0, yaw_deg=theta_deg)
            probes.append(probe_of("p", pose, felt(self.sign * 0.7 * x_mm, 0.7 * theta_deg)))
            answered(Answered(probes[-1], self.gels))
            await asyncio.sleep(0)
        return Ended(tuple(probes), Phase.PROBED, "", self.gels)

    async def fetch(self):
        self.fetched_n += 1


def commissioning(cell, path, record=None):
    record, draw = record or Record(begun="today", seed=7), errors(7, 15.0, 15.0, (2.5, 3.0))
    return Commissioning(path, record, cell.probe, cell.several, cell.fetch, draw, lambda _line: None)


def test_it_goes_on_where_it_was_broken_off_and_loses_the_probe_under_way(tmp_path):
    path, whole, broken = tmp_path / "record.toml", Cell(), Cell(fails_at=8)
    asyncio.run(commissioning(whole, tmp_path / "whole.toml").run(10))
    with pytest.raises(DriverError, match=r"probe 8 of 10.*tilt"):
        asyncio.run(commissioning(broken, path).run(10))
    assert read_record(path).labelled_n == 7
    record = asyncio.run(commissioning(broken, path, read_record(path)).run(10))
    assert (len(record.signs), len(record.probes), record.labelled_n) == (4, 6, 10)
    assert broken.probed[:7] + broken.probed[8:] == whole.probed
    assert whole.fetched_n == 4 + 2, "of the probes to learn from, five are made with one grasp"


def test_a_probe_whose_object_hangs_askew_is_repeated_in_a_new_grasp(tmp_path):
    class Askew(Cell):
        """The fixture hands the object over askew, at first."""

        async def probe(self, x_mm, theta_deg):
            ended = await super().probe(x_mm, theta_deg)
            if len(self.probed) not in askew:
                return ended
            return Ended((), Phase.FAILED, f"{REFUSED} it hangs turned by 0.6 deg", self.gels)

    askew, cell, shown = {2, 4, 5}, Askew(), []
    running = commissioning(cell, tmp_path / "record.toml")
    running.show = shown.append
    record = asyncio.run(running.run(4))
    assert (record.labelled_n, len(cell.probed), cell.fetched_n) == (4, 7, 7)
    assert cell.probed[1] == cell.probed[2], "the same error again"
    assert sum("not pressed in this grasp" in line and "0.6 deg" in line for line in shown) == 3
    askew = {1, 2, 3}
    with pytest.raises(DriverError, match="sign 1 of 4: service: refused: turned_in_hand"):
        asyncio.run(commissioning(Askew(), tmp_path / "another.toml").run(6))


def test_a_probe_whose_pictures_came_too_late_is_repeated_in_a_new_grasp(tmp_path):
    class Late(Cell):
        """A camera loses frames: the arm pauses in some presses, which then tell nothing of the wiring."""

        async def probe(self, x_mm, theta_deg):
            ended = await super().probe(x_mm, theta_deg)
            if len(self.probed) not in late:
                return ended
            pose = WorkPose(x_mm=x_mm, y_mm=0.0, z_mm=35.0, yaw_deg=theta_deg)
            return ended._replace(probes=(probe_of("late", pose, no_decision(1, "stale")),))

    late, cell, shown = {2, 5, 6}, Late(), []
    running = commissioning(cell, tmp_path / "record.toml")
    running.show = shown.append
    record = asyncio.run(running.run(4))
    assert (len(record.signs), len(cell.probed), cell.fetched_n, record.named) == (4, 7, 7, ())
    assert sum("nothing is learnt in this grasp: stale" in line for line in shown) == running.stale_n == 3
    late = set(range(1, 100))
    record = asyncio.run(commissioning(Late(), tmp_path / "another.toml").run(4))
    assert len(record.signs) == 4
    assert record.named
    assert all(why.startswith("stale") for why in record.named)


def test_presses_come_after_the_signs_once_and_older_records_keep_their_digest(tmp_path):
    cell, path, pressed = Cell(), tmp_path / "record.toml", []

    async def press(grip_n, x_mm, theta_deg):
        pressed.append((grip_n, x_mm, theta_deg))
        if len(pressed) == fails_at:
            raise DriverError("gripper: part_lost")
        return await cell.probe(x_mm, theta_deg)

    record = asyncio.run(commissioning(cell, path).run(2))
    was, fails_at = record.digest(), 4
    for _ in range(3):
        running = commissioning(cell, path, read_record(path))
        running.press, running.grips_n = press, (40.0, 20.0)
        with contextlib.suppress(DriverError):
            record = asyncio.run(running.run(2))
    todo = [(grip_n, *place) for grip_n in (40.0, 20.0) for place in PRESSES]
    assert pressed == [*todo, todo[-1]], "only the one that was cut off is pressed again"
    assert [(probe.x_mm, probe.theta_deg) for probe in record.presses] == [(x, theta) for _, x, theta in todo]
    assert record.digest() != was
    assert record.model_copy(update={"presses": ()}).digest() == was


def test_presses_count_among_the_probes_asked_for(tmp_path):
    """The robot's time is that of so many probes, whatever they are for."""
    cell, shown = Cell(), []
    running = commissioning(cell, tmp_path / "record.toml")
    running.show, running.grips_n = shown.append, (40.0, 20.0)
    running.press = lambda _grip_n, x_mm, theta_deg: cell.probe(x_mm, theta_deg)
    record = asyncio.run(running.run(10))
    assert (len(record.signs), len(record.presses), len(record.probes), record.labelled_n) == (4, 4, 2, 6)
    assert record.done_n == len(cell.probed) == 10
    assert [line.partition(":")[0] for line in shown][4:9] == [
        *(f"press {n} of 4 at {grip} N" for n, grip in ((1, 40), (2, 40), (3, 20), (4, 20))),
        "probe 9 of 10",
    ]


def test_what_a_full_disk_has_not_taken_is_not_counted(tmp_path):
    path, cell = tmp_path / "record.toml", Cell()
    record = asyncio.run(commissioning(cell, path).run(5))
    fill_before(path)
    running = commissioning(cell, path, record)
    with pytest.raises(ContractError, match="the last probe is not in it"):
        asyncio.run(running.run(6))
    assert running.record.done_n == read_record(path).done_n == 5
    assert list(tmp_path.iterdir()) == [path], "nor is a part of it left"

    class Filling(Cell):
        async def several(self, places, answered):
            fill_before(path)
            return await super().several(places, answered)

    running = commissioning(Filling(), path, record)
    with pytest.raises(ContractError, match="the last probe is not in it"):
        asyncio.run(running.run(9))
    assert running.record.done_n == read_record(path).done_n == 5


def test_no_record_has_all_signs_and_not_yet_their_mistakes(tmp_path, monkeypatch):
    """A power cut in between would leave a record from which wrong labels are learnt."""
    kept = []
    monkeypatch.setattr(
        commission_run, "keep_record", lambda path, record: (kept.append(record), keep_record(path, record))
    )
    asyncio.run(commissioning(Cell(sign=-1), tmp_path / "record.toml").run(0))
    assert [len(record.signs) for record in kept][:4] == [1, 2, 3, 4]
    assert all(bool(record.named) == (len(record.signs) == len(SIDES)) for record in kept)


ENDLESS = """
import asyncio, sys
from pathlib import Path
from tests.robot_client.session.test_commission import Cell, commissioning
asyncio.run(commissioning(Cell(), Path(sys.argv[1])).run(1000000))
"""


@pytest.mark.parametrize("least_n", [2, 7, 30])
def test_a_kill_at_any_point_loses_no_probe_that_was_kept(least_n, tmp_path):
    path, whole = tmp_path / "record.toml", Cell()
    process = subprocess.Popen([sys.executable, "-c", ENDLESS, str(path)])
    try:
        until_s = time.monotonic() + 60.0
        while (record := read_record(path)) is None or record.labelled_n < least_n:
            assert process.poll() is None
            assert time.monotonic() < until_s
    finally:
        process.kill()
        process.wait()
    record = read_record(path)
    total = max(record.labelled_n, len(SIDES) + 1)
    record = asyncio.run(commissioning(Cell(), path, record).run(total))
    asyncio.run(commissioning(whole, tmp_path / "whole.toml").run(total))
    probed = [(probe.x_mm, probe.theta_deg) for probe in (*record.signs, *record.probes)]
    assert len(probed) >= least_n
    assert probed == whole.probed


def test_nothing_goes_on_in_a_cell_with_the_wrong_signs(tmp_path):
    """It is not timed, not pressed and not probed."""
    cell = Cell(sign=-1)
    running = commissioning(cell, tmp_path / "record.toml")
    running.press, running.grips_n = lambda _grip_n, *place: cell.probe(*place), (40.0, 20.0)
    running.press_at = lambda x_mm, theta_deg, _fast: cell.probe(x_mm, theta_deg)
    record = asyncio.run(running.run(20))
    assert (len(cell.probed), record.timed, record.presses, record.probes) == (len(SIDES), (), (), ())
    assert record.named == (WIRINGS[-1, 1],)
    assert read_record(tmp_path / "record.toml").named == record.named


def test_a_gel_that_is_changed_on_the_way_ends_it(tmp_path):
    cell = Cell()
    record = asyncio.run(commissioning(cell, tmp_path / "record.toml").run(5))
    cell.gels = {"left": "a", "right": "c"}
    with pytest.raises(DriverError, match="gel was changed"):
        asyncio.run(commissioning(cell, tmp_path / "record.toml", record).run(9))
    assert read_record(tmp_path / "record.toml").probes == record.probes, "none of another gel is in it"


def camera(gel):
    return wire.CameraEntry(finger="left", source="s", state="live", frame_rate_hz=60.0, gel=gel)


@pytest.mark.parametrize(("gel", "goes_on"), [("a", True), ("z", False), ("", False)])
def test_nothing_is_inserted_with_a_gel_that_was_not_commissioned(gel, goes_on):
    plan = PLAN.model_copy(update={"gels": {"left": "a"}})
    state, _ = run([TO_ARMING[0], service(hello(cameras=(camera(gel),)))], State(plan))
    assert (state.phase is Phase.GRASPING) == goes_on
    assert goes_on or "left gel" in state.reason
