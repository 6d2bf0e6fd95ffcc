"""Ways outside an insertion: out of the blocks and into a fixture the arm moves along the vertical only."""

import asyncio
import contextlib
import itertools
import math
from dataclasses import replace

import pytest

from robot_client.cli.jog import _jog
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.insertion.events import Failure
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import LimitError, Limits, check_pose
from robot_client.insertion.motion import Ramp
from robot_client.ports import NOT_CONFIRMED, DriverError
from robot_client.robots.dry_run.driver import DryArm
from robot_client.robots.dry_run.driver import Settings as DryRun
from robot_client.session.afresh import Fixture
from robot_client.session.cycle import Cycle, CycleSettings
from robot_client.session.travel import over_to, straight_up
from robot_client.settings import Settings
from simulation.cell.emulators.abb.motion import Pose, tool_down
from tests.robot_client.live_cell import bench

LOW = WorkPose(x_mm=-20.0, y_mm=5.0, z_mm=10.0, yaw_deg=0.0)
TAUGHT = CycleSettings(pick=LOW, open_mm=80.0, retreat_mm=8.0)
BETWEEN_THE_BLOCKS = WorkPose(x_mm=0.0, y_mm=0.0, z_mm=12.0, yaw_deg=3.0)


def errands_of(way, start, **changed):
    """Errands of a rehearsed arm that stands at ``start`` and notes its targets in ``way``."""
    settings = Settings()

    def make_arm():
        return DryArm(settings.limits, settings.ramps, DryRun(start=start), on_target=way.append)

    return replace(settings.errands, make_arm=make_arm, make_gripper=DryGripper, **changed)


def heights_aside(way):
    """Where the arm moves sideways."""
    return [b.z_mm for a, b in itertools.pairwise(way) if math.hypot(b.x_mm - a.x_mm, b.y_mm - a.y_mm) > 1e-9]


@pytest.mark.parametrize("errand", ["cycle", "regrasp"])
def test_out_of_the_blocks_it_goes_up_to_the_approach_first_however_low_the_fixture_is(errand):
    way = []
    errands = errands_of(way, BETWEEN_THE_BLOCKS)
    if errand == "cycle":
        asyncio.run(errands.go(Cycle(TAUGHT, errands, None, print)._over_to(LOW)))
    else:
        asyncio.run(Fixture(LOW, TAUGHT.open_mm, TAUGHT.retreat_mm, errands).put_back())
    assert min(heights_aside(way)) == Settings().task.approach_z_mm
    assert way[-1] == LOW


def test_it_comes_to_a_fixture_from_above():
    way = []
    pick = LOW.at_height(45.0)
    errands = errands_of(way, BETWEEN_THE_BLOCKS)
    asyncio.run(errands.go(Cycle(TAUGHT, errands, None, print)._over_to(pick)))
    assert min(heights_aside(way)) == 45.0 + TAUGHT.retreat_mm


@pytest.mark.parametrize(("taught", "clear_mm"), [(None, Settings().task.approach_z_mm), (TAUGHT, 53.0)])
async def test_a_jog_draws_an_object_out_of_the_blocks_and_lowers_it_into_its_fixture(taught, clear_mm):
    """As after an insertion that ended in a hold."""
    if taught:
        taught = taught.model_copy(update={"pick": LOW.at_height(45.0)})
    end = LOW if taught is None else taught.pick
    async with bench() as cell:
        cell.cabinet.arm.pose = Pose((0.0, 0.0, 12.0), tool_down(3.0))
        cell.cabinet.arm.hold()
        assert (await _jog(cell.settings.model_copy(update={"cycle": taught}), end)).done
        path = [pose.position_mm for _, _, pose in cell.trace]
    assert min(z for x, _, z in path if -19.9 < x < -0.1) > clear_mm - 0.1
    assert path[-1] == pytest.approx((end.x_mm, end.y_mm, end.z_mm), abs=0.05)


def test_an_interrupt_while_the_fingers_move_does_not_say_that_it_came_between_two_steps():
    notes = []

    class Slow(DryGripper):
        async def release(self, _width_mm):
            await asyncio.Event().wait()

        async def close(self):
            notes.append("left in order")

    async def story():
        errands = replace(Settings().errands, make_gripper=Slow)
        task = asyncio.ensure_future(Cycle(TAUGHT, errands, None, print)._open())
        await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(DriverError, match="interrupted while the fingers moved: look where they stand"):
            await task

    asyncio.run(story())
    assert notes == ["left in order"]


def test_a_ramp_beyond_the_limits_moves_nothing():
    way = []
    fast = Ramp(speed_mm_s=100.0, acceleration_mm_s2=300.0, jerk_mm_s3=5000.0)
    errands = errands_of(way, BETWEEN_THE_BLOCKS, ramps=Settings().ramps.model_copy(update={"travel": fast}))
    with pytest.raises(LimitError, match=r"ramps.travel.speed_mm_s = 100"):
        asyncio.run(errands.go(lambda here: [(here.at_height(60.0), "travel")]))
    assert way == []


@pytest.mark.parametrize(
    ("moves_n", "reports", "fails"),
    [(0, False, LimitError), (0, True, DriverError), (1, False, DriverError), (2, False, DriverError)],
)
def test_an_arm_that_fails_between_two_lines_is_no_wrong_order(moves_n, reports, fails):
    class Failing(DryArm):
        ordered = 0

        async def start(self, post):
            if reports:
                post(Failure(at_s=0.0, source="arm", code="robot", detail="motors are off"))
            return await super().start(post)

        def move(self, *order):
            if self.ordered == moves_n:
                raise LimitError("the arm takes no motion: motors are off")
            Failing.ordered += 1
            super().move(*order)

    settings = Settings()
    errands = replace(settings.errands, make_arm=lambda: Failing(settings.limits, settings.ramps))
    with pytest.raises(fails, match="motors are off"):
        asyncio.run(errands.go(over_to(LOW, 40.0)))


@pytest.mark.parametrize("device", ["abb_egm", "abb_rapid"])
async def test_an_arm_beyond_half_a_turn_is_read_within_the_box_and_turns_no_further(device):
    box = {"limits": {"yaw_deg": [135.0, 225.0]}}
    async with asyncio.timeout(60.0), bench(device=device, overrides=box) as cell:
        cell.cabinet.arm.pose = Pose((5.0, 0.0, 40.0), tool_down(190.0))
        cell.cabinet.arm.hold()
        await cell.settings.errands.go(lambda here: [(here.at_height(41.0)._with(yaw_deg=192.0), "travel")])
        yaws_deg = [pose.yaw_deg % 360.0 for _, _, pose in cell.trace]
    assert min(yaws_deg) > 189.9
    assert max(yaws_deg) < 192.1


def test_a_box_of_more_than_a_turn_is_refused():
    with pytest.raises(ValueError, match="from -190 to 190 is more than a whole turn"):
        Limits(yaw_deg=(-190.0, 190.0))
    with pytest.raises(ValueError, match="from 10 to 371 is more than a whole turn"):
        Limits(yaw_deg=(10.0, 371.0))
    assert Limits(yaw_deg=(135.0, 495.0)).middle_yaw_deg == 315.0


EDGE = {"z_mm": [10.0, 80.0], "x_mm": [-20.0, 20.0], "y_mm": [-5.0, 5.0]}


@pytest.mark.parametrize("device", ["abb_egm", "abb_rapid"])
@pytest.mark.parametrize(
    ("at_mm", "leaves"), [((5.0, 0.0, 9.98), True), ((-20.02, 5.02, 45.0), True), ((-20.2, 0.0, 45.0), False)]
)
async def test_an_arm_that_was_sent_to_the_edge_of_the_box_leaves_it_from_a_little_beyond(device, at_mm, leaves):
    async with asyncio.timeout(60.0), bench(device=device, overrides={"limits": EDGE}) as cell:
        cell.cabinet.arm.pose = Pose(at_mm, tool_down(0.0))
        cell.cabinet.arm.hold()
        if leaves:
            here = await cell.settings.errands.go(over_to(WorkPose(x_mm=0.0, y_mm=0.0, z_mm=50.0, yaw_deg=0.0), 0.0))
            assert here.z_mm == pytest.approx(50.0, abs=0.1)
        else:
            with pytest.raises(LimitError, match=r"target x_mm = -20.200, allowed -20 .. 20"):
                await cell.settings.errands.go(straight_up(1.0))


def test_beyond_the_edge_it_goes_no_further():
    here = WorkPose(x_mm=-40.05, y_mm=0.0, z_mm=45.0, yaw_deg=0.0)
    for x_mm, allowed in ((-40.05, True), (-40.02, True), (-40.06, False), (40.01, False)):
        with contextlib.nullcontext() if allowed else pytest.raises(LimitError, match="x_mm"):
            check_pose(Limits(), here._with(x_mm=x_mm), here=here)


@pytest.mark.parametrize(
    ("farewell", "fails", "expected"),
    [
        (
            "controller confirms: program stopped, motors off: emergencystop",
            "arm",
            "^arm: link: gone; robot: contr.*stop$",
        ),
        (f"{NOT_CONFIRMED} by the controller", "arm", "^arm: link: gone; robot: STOP NOT CONFIRMED by the controller$"),
        ("program stopped", "operator", "^operator: interrupted, the arm is stopped; robot: program stopped$"),
        (f"{NOT_CONFIRMED} by the controller", "operator", "^operator: interrupted; robot: STOP NOT CONFIRMED by"),
        (f"{NOT_CONFIRMED} by the controller", "box", "^low z_mm = -1.000, .*; robot: STOP NOT CONFIRMED by"),
    ],
)
def test_an_errand_that_fails_says_why_and_how_the_controller_was_left(farewell, fails, expected):
    """What the controller says about an emergency stop, a guard stop or motors off comes with its farewell."""

    class Failing(DryArm):
        def move(self, *_order):
            self._post(Failure(at_s=0.0, source="arm", code="link", detail="gone"))

        async def start(self, post):
            self._post = post
            if fails == "operator":
                raise asyncio.CancelledError
            if fails == "box":
                raise LimitError("low z_mm = -1.000, allowed 5 .. 150")
            return LOW

        async def close(self):
            return farewell

    settings = Settings()
    errands = replace(settings.errands, make_arm=lambda: Failing(settings.limits, settings.ramps))
    with pytest.raises(DriverError, match=expected):
        asyncio.run(errands.go(over_to(LOW, 40.0)))
