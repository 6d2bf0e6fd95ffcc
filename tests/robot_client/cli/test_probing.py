"""A probe of `commission` on the configured devices: fingers that are open on the way down, the lease, the timing."""

import asyncio
from types import SimpleNamespace

import pytest

from robot_client.cli.commission import Probing
from robot_client.insertion.geometry import WorkPose
from robot_client.ports import DriverError, Gripper
from robot_client.robots.dry_run.driver import DryArm
from robot_client.robots.dry_run.driver import Settings as DryRun
from robot_client.session.cycle import CycleSettings
from robot_client.session.travel import Errands
from robot_client.settings import Settings

REAL = Settings(cycle=CycleSettings(pick=WorkPose(x_mm=-20.0, y_mm=5.0, z_mm=45.0, yaw_deg=0.0), open_mm=80.0))


class Fingers(Gripper):
    """Fingers at some width, empty or not."""

    def __init__(self, width_mm, empty=True):
        self.is_mm, self.empty = width_mm, empty

    async def connect(self):
        pass

    async def close(self):
        pass

    async def width_mm(self):
        return self.is_mm

    async def finds_nothing(self):
        self.is_mm = min(self.is_mm, 15.0) if self.empty else self.is_mm
        return self.empty

    async def release(self, width_mm):
        self.is_mm = width_mm
        return width_mm


class Moves(DryArm):
    """A rehearsed arm that notes how far apart the fingers are in each of its moves."""

    def __init__(self, fingers, widths):
        super().__init__(REAL.limits, REAL.ramps, DryRun(start=WorkPose(x_mm=0.0, y_mm=0.0, z_mm=75.0, yaw_deg=0.0)))
        self.fingers, self.widths = fingers, widths

    def move(self, *way):
        self.widths.append(self.fingers.is_mm)
        super().move(*way)


def fetched(fingers, tmp_path):
    """The width of the fingers in each move of the first way to the fixture."""
    widths = []
    errands = Errands(lambda: Moves(fingers, widths), lambda: fingers, REAL.limits, REAL.ramps, 3.0, 35.0)
    settings = SimpleNamespace(cycle=REAL.cycle, errands=errands, make_gripper=lambda: fingers)

    async def story():
        probing = Probing(settings, REAL.cycle, tmp_path)
        await probing.begin()
        await probing.fetch()

    asyncio.run(story())
    return widths


@pytest.mark.parametrize("width_mm", [20.0, 79.5, 85.0])
def test_the_fingers_are_open_before_they_go_down_to_the_fixture(tmp_path, width_mm):
    widths = fetched(Fingers(width_mm), tmp_path)
    assert widths
    assert min(widths) >= 79.0


def test_fingers_that_hold_something_go_nowhere(tmp_path):
    with pytest.raises(DriverError, match="holds something"):
        fetched(Fingers(40.0, empty=False), tmp_path)


@pytest.mark.parametrize("until_slip", [True, False])
@pytest.mark.parametrize(("late_s", "counts_s"), [(None, 0.04), (0.18, 0.18)])
def test_a_probe_reckons_with_the_lateness_as_soon_as_it_is_known(tmp_path, monkeypatch, until_slip, late_s, counts_s):
    plans = []

    async def run(_self, plan, _kept=None):
        plans.append(plan)

    monkeypatch.setattr(Probing, "_run", run)
    probing = Probing(REAL, REAL.cycle, tmp_path)
    probing.late_s = lambda: late_s
    asyncio.run(probing.probe(8.0, 8.0, until_slip=until_slip))
    asyncio.run(probing.press_at(8.0, 8.0, fast=True))
    assert [plan.lease.stop_lag_s for plan in plans] == [counts_s, 0.04], "the press that measures it presumes nothing"
