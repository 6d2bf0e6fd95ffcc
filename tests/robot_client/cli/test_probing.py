"""A probe of `commission` on the configured devices: fingers that are open on the way down, the lease, the timing."""

import asyncio
from types import SimpleNamespace

import pytest

from robot_client.cli.commission import Probing, _commission, grips_of, with_grip
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.grippers.dry_run.driver import Settings as DryGripperSettings
from robot_client.grippers.wsg50.settings import Settings as Wsg50Settings
from robot_client.insertion.events import Standstill
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.state import Phase, State
from robot_client.ports import DriverError
from robot_client.robots.dry_run.driver import DryArm
from robot_client.robots.dry_run.driver import Settings as DryRun
from robot_client.session.commission.kept_gripper import KeptGripper
from robot_client.session.commission.record import RECORD, Record, keep_record
from robot_client.session.commission.run import Ended
from robot_client.session.commission.wiring import probe_of
from robot_client.session.cycle import CycleSettings
from robot_client.session.travel import Errands
from robot_client.settings import Settings, Task
from service.contract import wire
from service.contract.shipped import released_models
from service.decision.models import load_models
from tests.robot_client.insertion.stories import APPROACH, ID, PLAN, TO_DESCENT, at, no_decision, run, service
from tests.robot_client.live_cell import Part, bench, undisturbed
from tests.robot_client.session.test_lateness import SLIPPED

REAL = Settings(cycle=CycleSettings(pick=WorkPose(x_mm=-20.0, y_mm=5.0, z_mm=45.0, yaw_deg=0.0), open_mm=80.0))


class Fingers(DryGripper):
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


@pytest.mark.parametrize(("width_mm", "held"), [(40.0, False), (79.5, True)])
def test_fingers_that_hold_something_go_nowhere(tmp_path, monkeypatch, width_mm, held):
    """Nor do they open: not even on a part that is as wide as the fingers were taught to open."""
    monkeypatch.setattr(Fingers, "held", held)
    fingers = Fingers(width_mm, empty=False)
    with pytest.raises(DriverError, match="holds something"):
        fetched(fingers, tmp_path)
    assert fingers.is_mm == width_mm


async def all_allowed(_probing, grips_n):
    return grips_n


@pytest.mark.parametrize("begun_before", [False, True])
def test_only_a_record_that_exists_is_named(tmp_path, monkeypatch, begun_before):
    """A commissioning that fails before its first probe is complete has written none."""
    lines = []
    monkeypatch.setattr("robot_client.cli.commission.show", lines.append)
    monkeypatch.setattr(Fingers, "held", True)
    monkeypatch.setattr(Probing, "allowed", all_allowed)
    errands = Errands(None, lambda: Fingers(79.5, empty=False), REAL.limits, REAL.ramps, 3.0, 35.0)
    settings = SimpleNamespace(cycle=REAL.cycle, errands=errands, make_gripper=lambda: Fingers(79.5, empty=False))
    path, record = tmp_path / RECORD, Record(begun="2026-01-01T00:00:00", seed=0, object="rectangle")
    if begun_before:
        keep_record(path, record)
    ended = asyncio.run(_commission(Probing(settings, REAL.cycle, tmp_path), 4, path, record, [None]))
    assert not ended.done
    assert ended.result["record"] == (str(path) if begun_before else None)
    assert lines[-1] == f"record: {path if begun_before else 'none, no probe was completed'}"


async def test_an_interrupt_while_the_gripper_is_left_does_not_hide_why_the_cell_holds(tmp_path, monkeypatch):
    """Nor say that nothing moves."""
    leaves, left = asyncio.Event(), asyncio.Event()

    async def refuses(_probing):
        raise DriverError("robot: STOP NOT CONFIRMED by the controller")

    async def leave(_gripper):
        leaves.set()
        await left.wait()

    monkeypatch.setattr(Probing, "allowed", all_allowed)
    monkeypatch.setattr(Probing, "begin", refuses)
    monkeypatch.setattr(KeptGripper, "leave", leave)
    record = Record(begun="2026-01-01T00:00:00", seed=0)
    task = asyncio.ensure_future(_commission(Probing(REAL, REAL.cycle, tmp_path), 4, tmp_path / RECORD, record, [None]))
    await asyncio.wait_for(leaves.wait(), 5.0)
    task.cancel()
    await asyncio.sleep(0)
    left.set()
    ended = await task
    assert (ended.done, ended.result["reason"]) == (False, "robot: STOP NOT CONFIRMED by the controller")


@pytest.mark.parametrize(("late_s", "counts_s"), [(None, 0.04), (0.18, 0.18)])
def test_a_probe_reckons_with_the_lateness_as_soon_as_it_is_known(tmp_path, monkeypatch, late_s, counts_s):
    plans = []

    async def run(_self, plan, *_):
        plans.append(plan)
        return Ended((probe_of("p", plan.approach, None),), Phase.PROBED, "", {})

    monkeypatch.setattr(Probing, "_run", run)
    probing = Probing(REAL, REAL.cycle, tmp_path)
    probing.late_s = lambda: late_s
    one, several = probing.probe(8.0, 8.0), probing.several([(8.0, 3.0), (-5.0, 1.0)], lambda _: None)
    for ends in (one, several, probing.press(20.0, 0.0, 15.0), probing.press_at(8.0, 8.0, fast=True)):
        asyncio.run(ends)
    assert [plan.lease.stop_lag_s for plan in plans] == [*[counts_s] * 3, 0.04], "the press that measures it"
    assert [plan.until_slip for plan in plans] == [False, False, True, False]
    assert [plan.signs_known for plan in plans] == [False, True, False, False]
    assert [(start.x_mm, start.yaw_deg) for start in plans[1].starts] == [(-5.0, 1.0)]


def measured_at(force_n):
    return Task(grip_n=0.5 * force_n, shear_reach_mm=0.02 * force_n)


@pytest.mark.parametrize(
    ("set_n", "one_grip", "grips_n"), [(40.0, False, [40.0, 20.0]), (15.0, False, [15.0, 30.0]), (40.0, True, [40.0])]
)
def test_presses_are_made_at_two_grips_one_twice_the_other(set_n, one_grip, grips_n):
    settings = REAL.model_copy(update={"gripper": Wsg50Settings(force_limit_n=set_n), "task": measured_at(set_n)})
    assert grips_of(settings, one_grip=one_grip) == grips_n
    pressed = with_grip(settings, grips_n[-1])
    assert pressed.gripper == Wsg50Settings(force_limit_n=grips_n[-1])
    assert pressed.task == measured_at(grips_n[-1]), "what was measured changes by as much"
    assert settings.task.grip_n == 0.5 * set_n
    assert grips_of(REAL.model_copy(update={"gripper": DryGripperSettings()}), one_grip=False) == [None]


class Grips(Part):
    """A part that notes each force that it is gripped with."""

    def __init__(self):
        super().__init__()
        self.forces_n = []

    def gripped(self, force_n):
        self.forces_n.append(force_n)


async def pressed_live(tmp_path):
    part, taught = Grips(), REAL.cycle.model_dump()
    async with bench(part=part, holding=False, overrides={"cycle": taught, "task": {"grip_n": 30.0}}) as cell:
        probing = Probing(cell.settings, cell.settings.cycle, tmp_path)
        allowed = [await probing.allowed(grips_n) for grips_n in ((40.0, 20.0), (40.0, 100.0), (40.0,))]
        presses = []
        for grip_n in (40.0, 20.0):
            presses.append(await probing.press(grip_n, 0.0, 15.0))
            await probing.fetch()
        arms = [message for message in cell.service.received if isinstance(message, wire.Arm)]
    return part, allowed, presses, arms


def test_a_press_grips_and_tells_the_service_what_was_asked_over_real_sockets(tmp_path, monkeypatch):
    lines = []
    monkeypatch.setattr("robot_client.cli.commission.show", lines.append)
    part, allowed, presses, arms = undisturbed(lambda: pressed_live(tmp_path))
    assert [round(force_n) for force_n in part.forces_n] == [40, 20]
    assert [(message.until_slip, message.grip_n) for message in arms] == [(True, 30.0), (True, 15.0)]
    assert [(ended.phase, ended.probes[0].grip_n) for ended in presses] == [(Phase.PROBED, 40.0), (Phase.PROBED, 20.0)]
    assert allowed == [[40.0, 20.0], [40.0], [40.0]]
    assert [line for line in lines if "AT ONE GRIP ONLY" in line] == [
        "PRESSES AT ONE GRIP ONLY: force_limit_n = 100, this gripper allows 5 .. 80"
    ]


async def several_live(tmp_path, places):
    async with bench(holding=False, overrides={"cycle": REAL.cycle.model_dump(), "task": {"grip_n": 30.0}}) as cell:
        probing, passed_on, received = Probing(cell.settings, cell.settings.cycle, tmp_path), [], []
        cell.service.on_message = received.append
        ended = await probing.several(places, passed_on.append)
        await probing.fetch()
        return ended, passed_on, received


def test_probes_from_several_starts_are_made_with_one_grasp_over_real_sockets(tmp_path):
    """The service's recording gets the start of each attempt, which is its label."""
    places = [(8.0, 4.0), (-9.0, 6.0), (5.0, -12.0)]
    ended, passed_on, received = undisturbed(lambda: several_live(tmp_path, places))
    assert ended.phase is Phase.PROBED, ended.reason
    assert [(probe.x_mm, probe.theta_deg) for probe in ended.probes] == places
    assert [answered.probe for answered in passed_on] == list(ended.probes)
    (episode,) = (message for message in received if isinstance(message, wire.Episode))
    assert [(pose.x_mm, pose.yaw_deg) for pose in (episode.approach, *episode.starts)] == places
    assert [message.attempt for message in received if isinstance(message, wire.Arm)] == [1, 2, 3]
    assert len([message for message in received if isinstance(message, wire.LearnOpen)]) == 1


async def allowed_live(tmp_path, grip_n):
    models = load_models(released_models()).entries
    tables = {"cycle": REAL.cycle.model_dump(), "task": {"grip_n": grip_n}}
    async with bench(holding=False, overrides=tables) as cell:
        plain = cell.service.hello
        cell.service.hello = lambda **asked: plain(**asked).model_copy(update={"models": models})
        return await Probing(cell.settings, cell.settings.cycle, tmp_path).allowed((40.0, 20.0))


@pytest.mark.parametrize(("grip_n", "allowed"), [(18.0, [40.0]), (20.0, [40.0, 20.0])])
def test_a_grip_on_which_the_networks_were_not_trained_is_left_out(tmp_path, monkeypatch, grip_n, allowed):
    """The service would refuse to press at it, in every run."""
    lines = []
    monkeypatch.setattr("robot_client.cli.commission.show", lines.append)
    assert undisturbed(lambda: allowed_live(tmp_path, grip_n)) == allowed
    assert any("grip_n is 9" in line for line in lines) == (allowed == [40.0])


def test_a_probe_tells_how_far_below_the_taught_tops_it_touched(tmp_path, monkeypatch):
    """By what the service felt of the press, when it ordered the stop, and by where the arm stood."""

    order = wire.Enough(insertion_id=ID, attempt=1, frame_seq=3, captured_ns=30_000_000, pressed_mm=0.8)

    class Played:
        farewell = ""

        def __init__(self, plan, _arm, _gripper, _service, log, observers, simulated):
            assert not simulated, "its recording says that the cell is real"
            self.plan, self.observers, self.log = plan, observers, log

        async def run(self):
            state = State(self.plan)
            still = at(APPROACH.at_height(APPROACH.z_mm - 7.5), Standstill)
            for event in (*TO_DESCENT, service(order, 0.05), still, service(no_decision(1)), at(APPROACH)):
                state, _ = run([event], state)
                for observer in self.observers:
                    observer.on_event(state, event)
            self.log.end({})
            return state

        def check_stopped(self):
            pass

    monkeypatch.setattr("robot_client.cli.commission.Runner", Played)
    monkeypatch.setattr("robot_client.cli.commission.live_ports", lambda *_: (None,) * 3)
    plan = PLAN.model_copy(update={"purpose": "probe"})
    ended = asyncio.run(Probing(REAL, REAL.cycle, tmp_path)._run(plan, DryGripper()))
    (probe,) = ended.probes
    assert probe.below_mm == pytest.approx(7.5 - 0.8 - 10.0 * 0.02 - plan.clearance_mm, abs=0.01)
    assert probe.touch_mm_s == 10.0
    assert probe.slid_mm is None
    order = SLIPPED
    for until_slip, slid_mm in ((True, 0.8), (False, None)):
        asked = plan.model_copy(update={"insertion_id": str(until_slip), "until_slip": until_slip})
        (probe,) = asyncio.run(Probing(REAL, REAL.cycle, tmp_path)._run(asked, DryGripper())).probes
        assert probe.slid_mm == slid_mm
