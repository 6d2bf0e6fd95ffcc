"""Several probes with one grasp: each is kept as it is answered, and what a grasp leaves is made with the next."""

import asyncio

import pytest

from robot_client.insertion.geometry import WorkPose
from robot_client.ports import DriverError
from robot_client.session.commission import run as commission_run
from robot_client.session.commission.record import read_record
from robot_client.session.commission.run import REFUSED
from robot_client.session.commission.wiring import probe_of
from tests.robot_client.insertion.stories import no_decision
from tests.robot_client.session.test_commission import Cell, commissioning


def test_probes_left_by_a_grasp_that_turned_are_made_with_the_next(tmp_path):
    cell, whole = Cell(fails_at=7, reason=f"{REFUSED} tilted"), Cell()
    record = asyncio.run(commissioning(cell, tmp_path / "record.toml").run(10))
    asyncio.run(commissioning(whole, tmp_path / "whole.toml").run(10))
    assert (record.labelled_n, cell.fetched_n) == (10, 4 + 2)
    assert [(probe.x_mm, probe.theta_deg) for probe in record.probes] == whole.probed[4:]


class Losing(Cell):
    """A camera loses frames: the arm pauses in every press whose number is in ``stale``."""

    def __init__(self, stale):
        super().__init__()
        self.stale = stale

    async def several(self, places, answered):
        def pass_on(one):
            late = no_decision(1, "stale") if len(self.probed) in self.stale else None
            pose = WorkPose(x_mm=one.probe.x_mm, y_mm=0.0, z_mm=35.0, yaw_deg=one.probe.theta_deg)
            answered(one._replace(probe=probe_of("late", pose, late)) if late else one)
            probes.append(probe_of("late", pose, late) if late else one.probe)

        probes = []
        ended = await super().several(places, pass_on)
        return ended._replace(probes=tuple(probes))


def test_an_attempt_whose_pictures_came_too_late_is_made_again_and_counts_for_nothing(tmp_path):
    cell, whole, shown = Losing({6, 8}), Cell(), []
    running = commissioning(cell, tmp_path / "record.toml")
    running.show = shown.append
    record = asyncio.run(running.run(9))
    asyncio.run(commissioning(whole, tmp_path / "whole.toml").run(9))
    assert (record.labelled_n, len(cell.probed), cell.fetched_n) == (9, 11, 4 + 2)
    assert {(probe.x_mm, probe.theta_deg) for probe in record.probes} == set(whole.probed[4:])
    assert sum("nothing is learnt from this attempt: stale" in line for line in shown) == running.stale_n == 2


def test_cameras_that_are_late_in_every_press_end_it(tmp_path):
    cell = Losing(set(range(5, 100)))
    with pytest.raises(DriverError, match="probe 5 of 9: nothing is learnt in 3 grasps in a row: stale"):
        asyncio.run(commissioning(cell, tmp_path / "record.toml").run(9))
    assert (read_record(tmp_path / "record.toml").labelled_n, cell.fetched_n) == (4, 4 + 3)


class Patient(Cell):
    """It waits until each answer has been kept, as a slow cell does."""

    async def several(self, places, answered):
        for place in places:
            ended = await super().several([place], answered)
            self.kept = asyncio.Event()
            await self.kept.wait()
        return ended


def test_a_probe_is_on_the_disk_while_the_next_one_with_its_grasp_is_made(tmp_path):
    path, cell, kept = tmp_path / "record.toml", Patient(), []
    running = commissioning(cell, path)

    def show(line):
        if line.startswith("probe"):
            kept.append((len(cell.probed), read_record(path).labelled_n))
            cell.kept.set()

    running.show = show
    asyncio.run(asyncio.wait_for(running.run(8), 20.0))
    assert kept == [(number, number) for number in range(5, 9)]


def test_the_time_left_is_told_by_the_probes_of_this_run(tmp_path, monkeypatch):
    """Those of the day before took none of it."""
    path, shown, now_s = tmp_path / "record.toml", [], 0.0

    class Timed(Patient):
        async def several(self, places, answered):
            nonlocal now_s
            for place in places:
                now_s += 15.0
                ended = await super().several([place], answered)
            return ended

    def show(line):
        shown.append(line)
        if line.startswith("probe"):
            cell.kept.set()

    cell = Timed()
    monkeypatch.setattr(commission_run.time, "monotonic", lambda: now_s)
    for total in (10, 30):
        running = commissioning(cell, path, read_record(path))
        running.show = show
        running._began_s = now_s
        asyncio.run(running.run(total))
    left = {line.partition(":")[0] for line in shown}
    assert "probe 15 of 30" in left
    assert "probe 16 of 30, 4 min left" in left, "15 of 15 s each, and one more that was made"
