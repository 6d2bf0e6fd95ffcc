"""Grasps, moves, stops and limits of the gripper, against the vendor's state machine."""

import struct

import pytest

from robot_client.grippers.wsg50.codec import encode_frame
from robot_client.grippers.wsg50.codes import Command, GraspingState, Status, SystemState
from tests.simulation.cell.emulators.wsg50.conftest import bits, state


def test_grasp_goes_through_pending_grasping_holding(cell, gripper):
    gripper.send(Command.GRASP, 80.0, 60.0)
    assert gripper.reply(Command.GRASP).status is Status.CMD_PENDING
    assert state(gripper) is GraspingState.GRASPING
    assert gripper.reply(Command.GRASP).status is Status.SUCCESS
    assert state(gripper) is GraspingState.HOLDING
    assert gripper.ask(Command.WIDTH, 0, 0).values[0] == pytest.approx(80.0)
    assert gripper.ask(Command.FORCE, 0, 0).values[0] == pytest.approx(40.0)
    cell.wait(lambda: cell.cell.world.held and bool(cell.physics.grips))
    assert cell.physics.grips[-1] == pytest.approx(40.0)


def test_grasping_nothing_fails_with_no_part(cell, gripper):
    cell.call(setattr, cell.cell.part, "_there", False)
    assert gripper.do(Command.GRASP, 80.0, 200.0) is Status.CMD_FAILED
    assert state(gripper) is GraspingState.NO_PART


def test_a_lost_grasp_shows_as_part_lost_by_auto_update(cell, gripper):
    assert gripper.do(Command.GRASP, 80.0, 200.0) is Status.SUCCESS
    gripper.ask(Command.GRASPING_STATE, 1, 20)
    assert gripper.reply(Command.GRASPING_STATE).values == (GraspingState.HOLDING,)
    cell.physics.lost = True
    cell.call(setattr, cell.cell.world, "_last", None)
    values = [gripper.reply(Command.GRASPING_STATE).values[0] for _ in range(8)]
    assert values[-1] == GraspingState.PART_LOST


def test_a_move_meets_the_part_and_reports_the_block(gripper):
    assert gripper.do(Command.MOVE, 2, 60.0, 200.0) is Status.AXIS_BLOCKED
    assert SystemState.BLOCKED_MINUS in bits(gripper)


def test_stop_aborts_the_pending_command(gripper):
    gripper.send(Command.MOVE, 0, 90.0, 5.0)
    assert gripper.reply(Command.MOVE).status is Status.CMD_PENDING
    gripper.send(Command.STOP)
    assert gripper.reply(Command.MOVE).status is Status.CMD_ABORTED
    assert state(gripper) is GraspingState.IDLE


def test_a_fast_stop_latches_until_it_is_acknowledged(gripper):
    gripper.send(Command.MOVE, 0, 90.0, 5.0)
    assert gripper.reply(Command.MOVE).status is Status.CMD_PENDING
    gripper.send(Command.FAST_STOP)
    assert gripper.reply(Command.MOVE).status is Status.CMD_ABORTED
    gripper.ask(Command.STOP)
    for order in ((Command.MOVE, 0, 90.0, 50.0), (Command.HOMING, 0), (Command.GRASP, 80.0, 50.0)):
        assert gripper.ask(*order).status is Status.ACCESS_DENIED
    assert state(gripper) is GraspingState.ERROR
    gripper.ask(Command.ACKNOWLEDGE, b"ack")
    assert gripper.do(Command.MOVE, 0, 90.0, 400.0) is Status.SUCCESS


def test_a_second_motion_is_refused_while_one_runs(gripper):
    gripper.send(Command.MOVE, 0, 90.0, 5.0)
    gripper.reply(Command.MOVE)
    assert gripper.ask(Command.GRASP, 80.0, 50.0).status is Status.ALREADY_RUNNING
    gripper.ask(Command.STOP)


@pytest.mark.parametrize(("asked", "reached"), [((120.0, 9999.0), 110.0), ((85.0, 421.0), 85.0)])
def test_a_move_beyond_the_physical_limits_goes_to_the_limit(gripper, asked, reached):
    assert gripper.ask(Command.SYSTEM_LIMITS).values[:3] == (110.0, 5.0, 420.0)
    assert gripper.do(Command.MOVE, 0, *asked) is Status.SUCCESS
    assert gripper.ask(Command.WIDTH, 0, 0).values[0] == pytest.approx(reached)


def test_fingers_snap_to_their_target_when_what_they_clamped_is_gone(cell, gripper):
    assert gripper.do(Command.MOVE, 0, 60.0, 200.0) is Status.AXIS_BLOCKED
    cell.call(setattr, cell.cell.part, "_there", False)
    cell.wait(lambda: cell.cell.gripper.width_mm == 60.0)
    assert gripper.ask(Command.FORCE, 0, 0).values[0] == 0.0


def test_a_move_that_meets_the_part_clamps_it_unless_it_was_told_to_stop(gripper):
    assert gripper.do(Command.MOVE, 0, 60.0, 200.0) is Status.AXIS_BLOCKED
    assert gripper.ask(Command.FORCE, 0, 0).values[0] == 40.0, "half of the nominal force"
    assert SystemState.FORCE_CONTROL_MODE not in bits(gripper), "no finger here measures force"
    gripper.do(Command.RELEASE, 100.0, 400.0)
    assert gripper.do(Command.MOVE, 2, 60.0, 200.0) is Status.AXIS_BLOCKED
    assert gripper.ask(Command.FORCE, 0, 0).values[0] == 0.0


@pytest.mark.parametrize("limits", [(80.0, 20.0), (50.0, 50.0), (-1.0, 50.0), (10.0, 111.0)])
def test_soft_limits_out_of_order_or_beyond_the_stroke_are_refused(gripper, limits):
    assert gripper.ask(Command.SET_SOFT_LIMITS, *limits).status is Status.RANGE_ERROR
    assert gripper.ask(Command.GET_SOFT_LIMITS).status is Status.NOT_AVAILABLE


def test_soft_limits_bound_the_moves_until_they_are_cleared(gripper):
    assert gripper.ask(Command.SET_SOFT_LIMITS, 85.0, 105.0).status is Status.SUCCESS
    assert gripper.ask(Command.MOVE, 0, 84.0, 100.0).status is Status.RANGE_ERROR
    assert gripper.do(Command.MOVE, 0, 105.0, 400.0) is Status.SUCCESS
    assert SystemState.SOFT_LIMIT_PLUS in bits(gripper)
    assert gripper.ask(Command.GET_SOFT_LIMITS).values == (85.0, 105.0)
    assert gripper.ask(Command.CLEAR_SOFT_LIMITS).status is Status.SUCCESS
    assert not bits(gripper) & (SystemState.SOFT_LIMIT_PLUS | SystemState.SOFT_LIMIT_MINUS)


def test_a_grasp_that_runs_into_the_restricted_area_is_a_fast_stop(cell, gripper):
    cell.call(setattr, cell.cell.part, "_there", False)
    gripper.ask(Command.SET_SOFT_LIMITS, 85.0, 110.0)
    assert gripper.do(Command.GRASP, 86.0, 200.0) is Status.RANGE_ERROR
    assert SystemState.FAST_STOP in bits(gripper)
    gripper.ask(Command.CLEAR_SOFT_LIMITS)


FORCE = Command.SET_FORCE_LIMIT, Command.GET_FORCE_LIMIT, 40.0
ACCELERATION = Command.SET_ACCELERATION, Command.GET_ACCELERATION, 1000.0


@pytest.mark.parametrize(
    ("setting", "asked", "taken"),
    [
        *((FORCE, asked, taken) for asked, taken in ((1000.0, 80.0), (1.0, 5.0), (33.0, 33.0))),
        *((ACCELERATION, asked, taken) for asked, taken in ((1e6, 5000.0), (1.0, 100.0))),
    ],
)
def test_a_setting_beyond_its_range_is_taken_as_the_nearest(gripper, setting, asked, taken):
    write, read, usual = setting
    assert gripper.ask(write, asked).status is Status.SUCCESS
    assert gripper.ask(read).values == (taken,)
    gripper.ask(write, usual)


def test_nothing_moves_before_homing(cell, gripper):
    cell.faults(gripper={"not_homed": True})
    assert gripper.ask(Command.WIDTH, 0, 0).values == (0.0,)
    assert gripper.ask(Command.GRASP, 80.0, 50.0).status is Status.NOT_INITIALIZED
    assert SystemState.REFERENCED not in bits(gripper)


def test_relative_moves_are_taken_relative_and_flagged(cell, gripper):
    before = gripper.ask(Command.WIDTH, 0, 0).values[0]
    gripper.sock.sendall(encode_frame(Command.MOVE, struct.pack("<Bff", 1, -3.0, 100.0)))
    gripper.reply(Command.MOVE)
    assert gripper.reply(Command.MOVE).status is Status.SUCCESS
    assert gripper.ask(Command.WIDTH, 0, 0).values[0] == pytest.approx(before - 3.0)
    assert cell.cell.wsg.counters.relative_moves >= 1
