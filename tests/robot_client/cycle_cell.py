"""A live cell with a fixture in it, for tests of the whole cycle."""

import asyncio
import contextlib
import random
from dataclasses import replace
from functools import partial

from robot_client.cli.insert import live_ports, make_plan
from robot_client.insertion.geometry import WorkPose
from robot_client.session.afresh import Fixture as Place
from robot_client.session.afresh import upright
from robot_client.session.cycle import Cycle, CycleSettings
from robot_client.session.handshake import Handshake
from robot_client.session.recorder import Recorder
from robot_client.session.runner import Runner
from service.contract import wire
from tests.robot_client.live_cell import bench

PICK = WorkPose(x_mm=-20.0, y_mm=5.0, z_mm=45.0, yaw_deg=0.0)
REJECT = WorkPose(x_mm=25.0, y_mm=-5.0, z_mm=40.0, yaw_deg=0.0)
OPEN_MM, RETREAT_MM = 80.0, 30.0
SIGNALS = ("diTactileStart", "doTactileReady", "doTactileDone", "doTactileFault")
QUICK = {
    "ramps": {
        "travel": {"speed_mm_s": 75.0, "acceleration_mm_s2": 300.0, "jerk_mm_s3": 5000.0},
        "descend": {
            "speed_mm_s": 4.0,
            "acceleration_mm_s2": 100.0,
            "jerk_mm_s3": 2000.0,
        },  # a long lease on a busy machine
    }
}


class Fixture:
    """Objects 50 mm wide: a new one stands at the pick pose each time the arm is there with open fingers.

    ``left`` is where each was let go of. Each is off by what it was drawn with, which only the service knows; one that
    was put back is taken again as it was.
    """

    def __init__(self, seed=0):
        self.random, self.held, self.left, self.sticky, self.cell = random.Random(seed), False, [], False, None
        self.is_put_back = False

    def width_mm(self):
        if self.cell is None:
            return None
        return 50.0 if self.held or self.sticky or self.is_there() else None

    def is_there(self):
        at = self.cell.cabinet.arm.pose.position_mm
        return abs(at[0] - PICK.x_mm) < 2.0 and abs(at[2] - PICK.z_mm) < 2.0

    def gripped(self, _force_n):
        if not self.held and not self.is_put_back:
            self.cell.service.offset = (self.random.uniform(-8, 8), self.random.uniform(-8, 8))
        self.held = True

    def released(self):
        x, theta = self.cell.service.error
        self.left.append((x, theta, self.cell.cabinet.arm.pose.position_mm))
        self.held, self.is_put_back = False, self.is_there()

    def lost(self):
        return False


@contextlib.asynccontextmanager
async def cell_with(seed=0, **overrides):
    part = Fixture(seed)
    taught = {"pick": PICK.model_dump(), "open_mm": OPEN_MM, "retreat_mm": RETREAT_MM}
    async with bench(holding=False, overrides={**QUICK, "cycle": taught, **overrides}, part=part) as cell:
        part.cell = cell
        cell.service.share = 1.0  # one correction is enough: these tests are about what comes before and after
        cell.cabinet.signals |= dict.fromkeys(SIGNALS, 0.0)
        yield cell, part


def cycle_of(cell, lines=None, **settings):
    taught = CycleSettings(pick=PICK, open_mm=OPEN_MM, retreat_mm=RETREAT_MM, **settings)
    spoken = [] if lines is None else lines

    async def insert(number):
        plan = make_plan(cell.settings, 0.0, 0.0, f"part-{number}-{len(spoken)}", None)
        return await upright(plan, partial(insertion, cell), fixture(cell), spoken.append)

    plc = Handshake(taught.plc, cell.settings.make_arm().signals()) if taught.plc else None
    return Cycle(taught, errands(cell), insert, spoken.append, plc=plc)


async def insertion(cell, plan):
    return await Runner(plan, *live_ports(cell.settings, plan), Recorder(None, plan)).run()


def turned(arm):
    name = {"insertion_id": arm.insertion_id, "attempt": arm.attempt}
    return wire.Refused(**name, reason="turned_in_hand", detail="by about 1.4 deg")


def errands(cell):
    return replace(cell.settings.errands, motion_s=20.0)


def fixture(cell):
    return Place(PICK, OPEN_MM, RETREAT_MM, errands(cell))


def run(work, timeout_s=110.0):
    return asyncio.run(asyncio.wait_for(work(), timeout_s))


def is_in(left):
    x, theta, at = left
    return abs(x) <= 2.5 and abs(theta) <= 3.5 and at[2] <= 24.0
