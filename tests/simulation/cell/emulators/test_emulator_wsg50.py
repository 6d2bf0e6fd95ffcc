"""The gripper over its binary protocol, against the vendor's test vectors and state machine."""

import socket
import struct
import time

import pytest

from robot_client.grippers.wsg50.codec import encode_frame
from robot_client.grippers.wsg50.codes import Command, GraspingState, Status, SystemState
from tests.simulation.physics.bench import WsgClient, bench


@pytest.fixture(scope="module")
def cell():
    with bench(gripper="open") as made:
        yield made


@pytest.fixture
def gripper(cell):
    cell.call(cell.cell.board.clear)
    cell.physics.lost = False
    cell.call(setattr, cell.cell.part, "_there", True)
    client = WsgClient(cell.told["gripper"])
    client.ask(Command.ACKNOWLEDGE, b"ack")
    client.do(Command.RELEASE, 100.0, 400.0)
    yield client
    client.close()
    cell.wait(lambda: cell.cell.wsg.connection is None)


def state(client):
    return GraspingState(client.ask(Command.GRASPING_STATE, 0, 0).values[0])


def bits(client):
    return SystemState(client.ask(Command.SYSTEM_STATE, 0, 0).values[0])


def test_vendor_bytes_of_homing_are_answered_with_vendor_bytes(cell, gripper):
    gripper.sock.sendall(bytes.fromhex("AAAAAA2001 00008F83"))
    data = gripper.sock.recv(100)
    assert data == bytes.fromhex("AAAAAA2002001A00") + data[-2:]
    gripper.sock.settimeout(30.0)
    assert gripper.sock.recv(100) == bytes.fromhex("AAAAAA2002000000B3FD")


def test_unknown_commands_answer_as_in_the_manual(gripper):
    gripper.sock.sendall(encode_frame(0x90))
    assert gripper.sock.recv(100) == bytes.fromhex("AAAAAA9002000E00FD02")


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


def test_a_second_motion_is_refused_while_one_runs(gripper):
    gripper.send(Command.MOVE, 0, 90.0, 5.0)
    gripper.reply(Command.MOVE)
    assert gripper.ask(Command.GRASP, 80.0, 50.0).status is Status.ALREADY_RUNNING
    gripper.ask(Command.STOP)


@pytest.mark.parametrize(("width", "speed"), [(120.0, 50.0), (-1.0, 50.0), (50.0, 4.0), (50.0, 421.0)])
def test_what_exceeds_the_reported_limits_is_refused(gripper, width, speed):
    limits = gripper.ask(Command.SYSTEM_LIMITS).values
    assert limits[:3] == (110.0, 5.0, 420.0)
    assert gripper.ask(Command.MOVE, 0, width, speed).status is Status.RANGE_ERROR


def test_a_move_that_meets_the_part_clamps_it_unless_it_was_told_to_stop(gripper):
    assert gripper.do(Command.MOVE, 0, 60.0, 200.0) is Status.AXIS_BLOCKED
    assert gripper.ask(Command.FORCE, 0, 0).values[0] > 0.0
    assert SystemState.FORCE_CONTROL_MODE in bits(gripper)
    gripper.do(Command.RELEASE, 100.0, 400.0)
    assert gripper.do(Command.MOVE, 2, 60.0, 200.0) is Status.AXIS_BLOCKED
    assert gripper.ask(Command.FORCE, 0, 0).values[0] == 0.0


@pytest.mark.parametrize("limits", [(80.0, 20.0), (50.0, 50.0), (-1.0, 50.0), (10.0, 111.0)])
def test_soft_limits_out_of_order_or_beyond_the_stroke_are_refused(gripper, limits):
    assert gripper.ask(Command.SET_SOFT_LIMITS, *limits).status is Status.RANGE_ERROR
    assert gripper.ask(Command.GET_SOFT_LIMITS).values == (0.0, 110.0)


def test_soft_limits_bound_the_moves_until_they_are_cleared(gripper):
    assert gripper.ask(Command.SET_SOFT_LIMITS, 85.0, 105.0).status is Status.SUCCESS
    assert gripper.ask(Command.MOVE, 0, 84.0, 100.0).status is Status.RANGE_ERROR
    assert gripper.do(Command.MOVE, 0, 105.0, 400.0) is Status.SUCCESS
    assert SystemState.SOFT_LIMIT_PLUS in bits(gripper)
    assert gripper.ask(Command.CLEAR_SOFT_LIMITS).status is Status.SUCCESS
    assert not bits(gripper) & (SystemState.SOFT_LIMIT_PLUS | SystemState.SOFT_LIMIT_MINUS)


@pytest.mark.parametrize(("asked", "taken"), [(1000.0, 80.0), (1.0, 5.0), (33.0, 33.0)])
def test_a_force_beyond_its_range_is_taken_as_the_nearest(gripper, asked, taken):
    assert gripper.ask(Command.SET_FORCE_LIMIT, asked).status is Status.SUCCESS
    assert gripper.ask(Command.GET_FORCE_LIMIT).values == (taken,)
    gripper.ask(Command.SET_FORCE_LIMIT, 40.0)


def raw(gripper, command, payload=b""):
    """Status and parameters of a command that our codec does not know."""
    gripper.sock.sendall(encode_frame(command, payload))
    data = gripper.sock.recv(200)
    length = struct.unpack("<H", data[4:6])[0]
    assert (data[:3], data[3]) == (b"\xaa" * 3, command)
    return Status(struct.unpack("<H", data[6:8])[0]), data[8 : 6 + length]


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (0x37, b"\0", Status.NOT_AVAILABLE),
        (0x38, b"", Status.NOT_AVAILABLE),
        (0x38, b"x", Status.NO_PARAM_EXPECTED),
        (0x42, b"", Status.NOT_ENOUGH_PARAMS),
        *((command, b"\0", Status.NOT_AVAILABLE) for command in range(0x60, 0x64)),
        (0x60, b"\7", Status.INDEX_OUT_OF_BOUNDS),
        (0x52, b"x" * 65, Status.RANGE_ERROR),
    ],
)
def test_what_foreign_drivers_ask_is_answered_by_name(gripper, command, payload, status):
    assert raw(gripper, command, payload)[0] is status


def test_temperature_tag_and_statistics_are_told(gripper):
    assert raw(gripper, 0x46, bytes(3)) == (Status.SUCCESS, struct.pack("<h", 365))
    assert raw(gripper, 0x52, b"left of two") == (Status.SUCCESS, b"")
    assert raw(gripper, 0x51) == (Status.SUCCESS, b"left of two")
    raw(gripper, 0x42, b"\1")
    gripper.do(Command.GRASP, 80.0, 200.0)
    assert raw(gripper, 0x42, b"\0") == (Status.SUCCESS, struct.pack("<IHH", 1, 0, 0))


def test_nothing_moves_before_homing(cell, gripper):
    cell.faults(gripper={"not_homed": True})
    assert gripper.ask(Command.GRASP, 80.0, 50.0).status is Status.NOT_INITIALIZED
    assert SystemState.REFERENCED not in bits(gripper)


def test_a_client_that_vanishes_leaves_a_fast_stop_until_acknowledged(cell, gripper):
    gripper.reset()
    cell.wait(lambda: cell.cell.wsg.connection is None)
    again = WsgClient(cell.told["gripper"])
    assert SystemState.FAST_STOP in bits(again)
    assert state(again) is GraspingState.ERROR
    assert again.ask(Command.MOVE, 0, 90.0, 50.0).status is Status.ACCESS_DENIED
    assert again.ask(Command.ACKNOWLEDGE, b"ack").status is Status.SUCCESS
    assert again.do(Command.MOVE, 0, 90.0, 400.0) is Status.SUCCESS
    again.close()


def test_a_goodbye_prevents_the_fast_stop(cell, gripper):
    gripper.close()
    cell.wait(lambda: cell.cell.wsg.connection is None)
    again = WsgClient(cell.told["gripper"])
    assert SystemState.FAST_STOP not in bits(again)
    again.close()


def test_only_one_client_at_a_time(cell, gripper):
    state(gripper)
    second = socket.create_connection(gripper.sock.getpeername(), timeout=30.0)
    assert second.recv(1) == b""
    second.close()
    assert state(gripper) is not GraspingState.ERROR


def test_auto_updates_come_at_their_period_and_on_change_only_then(gripper):
    gripper.ask(Command.WIDTH, 1, 20)
    begin = time.monotonic()
    for _ in range(10):
        gripper.reply(Command.WIDTH)
    assert time.monotonic() - begin > 0.12
    gripper.ask(Command.WIDTH, 3, 20)
    gripper.reply(Command.WIDTH)
    gripper.sock.settimeout(0.2)
    with pytest.raises(TimeoutError):
        gripper.reply(Command.WIDTH)
    gripper.sock.settimeout(30.0)


def test_relative_moves_are_taken_relative_and_flagged(cell, gripper):
    before = gripper.ask(Command.WIDTH, 0, 0).values[0]
    gripper.sock.sendall(encode_frame(Command.MOVE, struct.pack("<Bff", 1, -3.0, 100.0)))
    gripper.reply(Command.MOVE)
    assert gripper.reply(Command.MOVE).status is Status.SUCCESS
    assert gripper.ask(Command.WIDTH, 0, 0).values[0] == pytest.approx(before - 3.0)
    assert cell.cell.wsg.counters.relative_moves >= 1


def test_wrong_crc_garbage_silence_and_reset_can_be_had(cell, gripper):
    cell.faults(wsg={"wrong_crc_next": 1, "garbage_next": 1})
    gripper.send(Command.WIDTH, 0, 0)
    gripper.send(Command.FORCE, 0, 0)
    assert gripper.reply(Command.FORCE).status is Status.SUCCESS
    assert gripper.parser.crc_errors >= 1
    cell.faults(wsg={"silent": True})
    gripper.sock.settimeout(0.2)
    with pytest.raises(TimeoutError):
        gripper.ask(Command.WIDTH, 0, 0)
    cell.faults(wsg={"silent": False, "reset_now": True})
    gripper.sock.settimeout(30.0)
    with pytest.raises(ConnectionError):
        gripper.reply(Command.LOOP)
