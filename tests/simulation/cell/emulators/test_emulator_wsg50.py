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
    client = WsgClient(cell.description["gripper"])
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
        (0x06, b"x" * 257, Status.CMD_FORMAT_ERROR),
        (0x24, b"nak", Status.CMD_FORMAT_ERROR),
        (0x37, b"\0", Status.SUCCESS),
        (0x38, b"", Status.NOT_AVAILABLE),
        (0x38, b"x", Status.NO_PARAM_EXPECTED),
        (0x42, b"", Status.CMD_FORMAT_ERROR),
        (0x46, bytes(3), Status.NO_PARAM_EXPECTED),
        (0x51, b"x" * 65, Status.OVERRUN),
        (0x51, b"\x1b[2J", Status.INVALID_PARAMETER),
        (0x52, b"", Status.NOT_AVAILABLE),
        *((command, b"\0", Status.CMD_FORMAT_ERROR) for command in (0x60, 0x61, 0x63, 0x70, 0x71, 0x73)),
        *((command, b"", Status.NOT_AVAILABLE) for command in (0x63, 0x73)),
        (0x64, b"", Status.CMD_UNKNOWN),
    ],
)
def test_what_foreign_drivers_ask_is_answered_as_in_the_manual(gripper, command, payload, status):
    assert raw(gripper, command, payload)[0] is status


def test_temperature_tag_and_statistics_are_told(gripper):
    assert raw(gripper, 0x46) == (Status.SUCCESS, struct.pack("<h", 365))
    assert raw(gripper, 0x51, b"left of two\0") == (Status.SUCCESS, b"")
    assert raw(gripper, 0x52) == (Status.SUCCESS, b"left of two")
    raw(gripper, 0x51)
    raw(gripper, 0x42, b"\1")
    gripper.do(Command.GRASP, 80.0, 200.0)
    assert raw(gripper, 0x42, b"\0") == (Status.SUCCESS, struct.pack("<IHH", 1, 0, 0))


@pytest.mark.parametrize("finger", [0x60, 0x70])
def test_a_generic_finger_is_switched_off_at_once_and_on_in_two_steps(gripper, finger):
    assert raw(gripper, finger) == (Status.SUCCESS, bytes(3))
    assert raw(gripper, finger + 2, b"\0")[0] is Status.SUCCESS
    assert raw(gripper, finger + 1) == (Status.SUCCESS, bytes(2))
    assert raw(gripper, finger + 2, b"\1")[0] is Status.CMD_PENDING
    assert gripper.reply(finger + 2).status is Status.SUCCESS
    assert raw(gripper, finger + 1) == (Status.SUCCESS, b"\1\0")


def test_overdrive_shows_in_the_state(gripper):
    raw(gripper, 0x37, b"\1")
    assert SystemState.OVERDRIVE_MODE in bits(gripper)
    raw(gripper, 0x37, b"\0")
    assert SystemState.OVERDRIVE_MODE not in bits(gripper)


def test_after_the_goodbye_nothing_is_accepted(gripper):
    gripper.ask(Command.DISCONNECT)
    assert gripper.ask(Command.WIDTH, 0, 0).status is Status.ACCESS_DENIED


def test_datagrams_are_answered_like_the_stream_and_cannot_say_goodbye(cell, gripper):
    """The bytes are those that drake-schunk-driver's demo sends."""
    gripper.close()
    cell.wait(lambda: cell.cell.wsg.connection is None)
    host, port = cell.description["gripper_udp"].split(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.settimeout(30.0)
        udp.sendto(bytes.fromhex("AAAAAA 21 0900 00 0000A042 0000F041 8038"), (host, int(port)))
        replies = [udp.recv(200) for _ in range(2)]
        udp.sendto(encode_frame(Command.DISCONNECT), (host, int(port)))
        assert [Status(struct.unpack("<H", reply[6:8])[0]) for reply in (*replies, udp.recv(200))] == [
            Status.CMD_PENDING,
            Status.AXIS_BLOCKED,
            Status.NOT_AVAILABLE,
        ]


def test_nothing_moves_before_homing(cell, gripper):
    cell.faults(gripper={"not_homed": True})
    assert gripper.ask(Command.WIDTH, 0, 0).values == (0.0,)
    assert gripper.ask(Command.GRASP, 80.0, 50.0).status is Status.NOT_INITIALIZED
    assert SystemState.REFERENCED not in bits(gripper)


def test_a_client_that_vanishes_leaves_a_fast_stop_until_acknowledged(cell, gripper):
    gripper.reset()
    cell.wait(lambda: cell.cell.wsg.connection is None)
    again = WsgClient(cell.description["gripper"])
    assert SystemState.FAST_STOP in bits(again)
    assert state(again) is GraspingState.ERROR
    assert again.ask(Command.MOVE, 0, 90.0, 50.0).status is Status.ACCESS_DENIED
    assert again.ask(Command.ACKNOWLEDGE, b"ack").status is Status.SUCCESS
    assert again.do(Command.MOVE, 0, 90.0, 400.0) is Status.SUCCESS
    again.close()


def test_a_goodbye_prevents_the_fast_stop(cell, gripper):
    gripper.close()
    cell.wait(lambda: cell.cell.wsg.connection is None)
    again = WsgClient(cell.description["gripper"])
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
