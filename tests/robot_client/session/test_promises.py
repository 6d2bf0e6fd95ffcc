"""The promises of the ports: the shipped drivers keep them, and one that does not is named, and goes no further."""

import asyncio
import time

import pytest

from robot_client.__main__ import main
from robot_client.insertion.events import Grasped, PartLost, Standstill
from robot_client.insertion.state import Phase
from robot_client.ports import NOT_CONFIRMED, DriverError
from robot_client.session.trial.arm import ArmTrial
from robot_client.session.trial.gripper import try_empty, try_part
from tests.robot_client.insertion.stories import PLAN, TO_ARMING
from tests.robot_client.live_cell import Part, bench, undisturbed
from tests.robot_client.session.test_runner import Port, runner, way_of

SLOW = {"lease": {"stop_lag_s": 0.15}}  # a busy machine may be late


class Wrong:
    """A driver as it is, but for what a subclass gets wrong."""

    def __init__(self, driver):
        self.driver = driver

    def __getattr__(self, name):
        return getattr(self.driver, name)


class StopsNot(Wrong):
    async def start(self, post):
        self.post = post
        return await self.driver.start(post)

    def hold(self, _reason, *, stop):  # noqa: ARG002 the port's signature
        if self.driver.position() is not None:
            self.post(Standstill(at_s=time.monotonic(), pose=self.driver.position()))


class ForgetsItsLease(Wrong):
    def move(self, target, motion, until_s=None, *legs):
        self.driver.move(target, motion, until_s and until_s + 60.0, *legs)


class TakesNoLegs(Wrong):
    def move(self, target, motion, until_s=None):
        self.driver.move(target, motion, until_s)


class IgnoresItsLegs(Wrong):
    def move(self, target, motion, until_s=None, _legs=()):
        self.driver.move(target, motion, until_s)


class IgnoresRenewals(Wrong):
    def renew(self, _until_s):
        pass


class RepeatsItsPosition(Wrong):
    first = None

    def position(self):
        self.first = self.first or self.driver.position()
        return self.first


class ArrivesEarly(Wrong):
    async def start(self, post):
        def early(event):
            post(event.model_copy(update={"pose": event.pose.at_height(event.pose.z_mm - 2.0)}))

        return await self.driver.start(early)


class BreaksBeforeItsStart(Wrong):
    def hold(self, reason, *, stop):
        if self.driver.position() is None:
            raise AttributeError("no guide yet")
        self.driver.hold(reason, stop=stop)


class RepeatsItsWidth(Wrong):
    async def width_mm(self):
        return 109.0


class GraspsNothing(Wrong):
    async def start(self, post):
        self.post = post
        await self.driver.start(post)

    def grasp(self):
        self.post(Grasped(at_s=time.monotonic(), width_mm=20.0))


class LosesNothing(Wrong):
    async def start(self, post):
        await self.driver.start(lambda event: None if isinstance(event, PartLost) else post(event))


class OpensWhenItLeaves(Wrong):
    async def close(self):
        if self.driver.held:
            await self.driver.release(90.0)
        await self.driver.close()


async def arm_findings(device="abb_egm", wrong=lambda arm: arm, **overrides):
    async with bench(device=device, overrides=SLOW | overrides) as cell:
        settings, findings = cell.settings, []
        arm = wrong(settings.make_arm())
        limits, ramps, lease, timeouts = settings.limits, settings.ramps, settings.lease, settings.timeouts
        await ArmTrial(arm, limits, ramps, lease, timeouts, settings.robot.pauses).run(findings.append)
        return findings


async def empty_findings(wrong=lambda gripper: gripper):
    async with bench(part=Part(present=False), holding=False) as cell:
        findings = []
        await try_empty(lambda: wrong(cell.settings.make_gripper()), 5.0, findings.append)
        return findings


async def part_findings(wrong=lambda gripper: gripper):
    part = Part()
    async with bench(part=part, holding=False) as cell:
        findings = []

        def pull(_text):
            part.lost = lambda: True

        await try_part(lambda: wrong(cell.settings.make_gripper()), 5.0, findings.append, pull)
        return findings


def bad(findings):
    return [finding.text for finding in findings if not finding.good]


@pytest.mark.parametrize("device", ["abb_egm", "abb_rapid"])
def test_the_shipped_arms_keep_every_promise(device):
    findings = undisturbed(lambda: arm_findings(device))
    assert bad(findings) == []
    assert [finding.text.partition(":")[0] for finding in findings] == [
        "move",
        "hold",
        *(["legs"] if device == "abb_egm" else []),
        "lease",
        "after a failure",
        "close",
    ]


def test_an_arm_that_descends_fast_has_room_for_both_descents():
    """Not accused of an arrival where its hold, or the end of its lease, was to be tried."""
    fast = {"speed_mm_s": 25.0, "acceleration_mm_s2": 400.0, "jerk_mm_s3": 8000.0}
    settings = {"ramps": {"descend": fast}, "limits": {"max_descent_speed_mm_s": 25.0}}
    assert bad(undisturbed(lambda: arm_findings(**settings))) == []


@pytest.mark.parametrize("story", [empty_findings, part_findings])
def test_the_shipped_gripper_keeps_every_promise(story):
    findings = undisturbed(story)
    assert bad(findings) == []
    assert len(findings) >= 5


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (StopsNot, "hold: went on by "),
        (ForgetsItsLease, "lease: no event followed within 0.5 s"),
        (TakesNoLegs, "legs: TypeError: "),
        (IgnoresItsLegs, "legs: at most 1."),
        (IgnoresRenewals, "legs: failure unwatched: "),
        (RepeatsItsPosition, "move: arrived; 1 positions on the way"),
        (ArrivesEarly, "the arm ended its move 2.0"),
        (BreaksBeforeItsStart, "hold before the start: AttributeError: no guide yet, expected no error"),
    ],
)
def test_an_arm_that_breaks_a_promise_is_named(wrong, named):
    assert bad(asyncio.run(arm_findings(wrong=wrong)))[0].startswith(named)


def test_an_arm_that_may_be_late_may_not_be_early():
    late = {"lease": {"stop_lag_s": 0.25}}
    assert bad(asyncio.run(arm_findings(wrong=IgnoresItsLegs, **late)))[0].startswith("legs: at most 1.")


@pytest.mark.parametrize(
    ("story", "wrong", "named"),
    [
        (empty_findings, RepeatsItsWidth, "width_mm: 10"),
        (empty_findings, GraspsNothing, "grasp of nothing: grasped, expected a failure"),
        (part_findings, LosesNothing, "pulled out: no event in time, expected part_lost"),
        (part_findings, OpensWhenItLeaves, "close: 50."),
    ],
)
def test_a_gripper_that_breaks_a_promise_is_named(story, wrong, named, monkeypatch):
    monkeypatch.setattr("robot_client.session.trial.gripper.PULL_S", 1.0)
    assert any(text.startswith(named) for text in bad(asyncio.run(story(wrong))))


@pytest.mark.parametrize("error", [DriverError("robot: not ready"), asyncio.CancelledError()])
async def test_a_try_whose_arm_may_still_move_says_that_first(error):
    """Not that it failed safe, nor that it was interrupted."""
    arm, findings = Port("arm", [], farewell=f"{NOT_CONFIRMED} by the controller: use the stop button"), []

    async def start(_post):
        raise error

    arm.start = start
    arm.closing.set()
    with pytest.raises(DriverError, match="robot: STOP NOT CONFIRMED by the controller"):
        await ArmTrial(arm, PLAN.limits, PLAN.ramps, PLAN.lease, PLAN.timeouts, False).run(findings.append)
    assert [finding.good for finding in findings] == [False]


async def test_fingers_that_are_closed_already_are_refused():
    async with bench(part=Part(present=False), holding=False) as cell:
        cell.gripper.width_mm = 0.0
        with pytest.raises(DriverError, match=r"the fingers are .* mm apart, expected open ones"):
            await try_empty(cell.settings.make_gripper, 5.0, print)


def test_nothing_moves_without_live(capsys):
    assert main(["try", "arm"]) == 0
    assert "go up by 15 mm" in capsys.readouterr().out


@pytest.mark.parametrize(("order", "named"), [("grasp", "gripper"), ("move", "arm"), ("send", "service")])
def test_an_order_that_a_driver_breaks_on_names_that_driver(order, named):
    """Whichever driver's event led to it: they often come from the service."""

    def broken(*_order):
        raise OSError("no route")

    run = runner([])
    for port in (run.arm, run.gripper, run.service):
        port.move = lambda *_order: None
        setattr(port, order, broken)
    for event in TO_ARMING:
        run.post(event)
    assert run.state.phase is Phase.FAILED
    assert run.state.reason.startswith(f"{named}: internal: order ")
    assert run.state.reason.endswith(": OSError: no route")


def test_an_arrival_elsewhere_than_at_the_target_ends_the_insertion():
    """As of a driver whose controller broke a move off, or that counts in metres."""
    run = runner([])
    run.arm.move, run.gripper.grasp = lambda *_order: None, lambda: None
    for event in TO_ARMING[:-1]:
        run.post(event)
    assert run.state.phase is Phase.APPROACHING
    run.post(TO_ARMING[-1].model_copy(update={"pose": PLAN.approach.at_height(PLAN.approach.z_mm + 1.1)}))
    assert run.state.reason.startswith("arm: tracking: the arm ended its move 1.10 mm and 0.00 deg away")


@pytest.mark.parametrize("moving", ["insertion", "way"])
@pytest.mark.parametrize("farewell", [None, "hangs"])
async def test_an_arm_whose_driver_does_not_tell_how_it_ended_may_still_move(moving, farewell, monkeypatch):
    monkeypatch.setattr("robot_client.session.runner.CLOSING_S", 0.2)
    run = runner([], service="gone")
    arm = Port("arm", [])
    arm.start = lambda _post: asyncio.sleep(0, PLAN.approach)

    async def close():
        await asyncio.sleep(60.0 if farewell else 0.0)

    arm.close = run.arm.close = close
    steps = {"insertion": run.run, "way": way_of(arm)}

    async def ended():
        await steps[moving]()
        run.check_stopped()

    with pytest.raises(DriverError, match=NOT_CONFIRMED):
        await asyncio.wait_for(ended(), 5.0)
