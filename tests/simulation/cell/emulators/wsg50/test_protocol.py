"""Bytes, refusals, connecting and leaving clients, and foreign drivers' requests, against the vendor's manual."""

import socket
import struct
import time

import pytest

from robot_client.grippers.wsg50.codec import encode_frame
from robot_client.grippers.wsg50.codes import Command, GraspingState, Status, SystemState
from tests.simulation.cell.emulators.wsg50.conftest import bits, state
from tests.simulation.physics.bench import WsgClient


def test_vendor_bytes_of_homing_are_answered_with_vendor_bytes(cell, gripper):
    gripper.sock.sendall(bytes.fromhex("AAAAAA2001 00008F83"))
    data = gripper.sock.recv(100)
    assert data == bytes.fromhex("AAAAAA2002001A00") + data[-2:]
    gripper.sock.settimeout(30.0)
    assert gripper.sock.recv(100) == bytes.fromhex("AAAAAA2002000000B3FD")


def test_unknown_commands_answer_as_in_the_manual(gripper):
    gripper.sock.sendall(encode_frame(0x90))
    assert gripper.sock.recv(100) == bytes.fromhex("AAAAAA9002000E00FD02")


def raw(gripper, command, payload=b""):
    """Status, alone in its answer, of a command that our codec does not know."""
    gripper.sock.sendall(encode_frame(command, payload))
    data = gripper.sock.recv(200)
    assert data[:6] == b"\xaa\xaa\xaa" + struct.pack("<BH", command, 2)
    return Status(struct.unpack("<H", data[6:8])[0])


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (0x06, b"x" * 257, Status.CMD_FORMAT_ERROR),
        (0x24, b"nak", Status.CMD_FORMAT_ERROR),
        (0x37, b"\0", Status.NOT_AVAILABLE),
        (0x37, b"", Status.CMD_FORMAT_ERROR),
        (0x38, b"", Status.NOT_AVAILABLE),
        (0x38, b"x", Status.NO_PARAM_EXPECTED),
        (0x42, b"", Status.CMD_FORMAT_ERROR),
        (0x42, b"\0", Status.NOT_AVAILABLE),
        (0x46, b"", Status.NOT_AVAILABLE),
        (0x46, bytes(3), Status.NO_PARAM_EXPECTED),
        (0x51, b"x" * 65, Status.OVERRUN),
        (0x51, b"left of two\0", Status.NOT_AVAILABLE),
        (0x52, b"", Status.NOT_AVAILABLE),
        *((command, b"\0", Status.CMD_FORMAT_ERROR) for command in (0x60, 0x61, 0x63, 0x70, 0x71, 0x73)),
        *((command, b"", Status.NOT_AVAILABLE) for command in (0x60, 0x61, 0x63, 0x70, 0x71, 0x73)),
        *((command, b"\1", Status.NOT_AVAILABLE) for command in (0x62, 0x72)),
        (0x64, b"", Status.CMD_UNKNOWN),
    ],
)
def test_what_foreign_drivers_ask_is_answered_as_in_the_manual(gripper, command, payload, status):
    assert raw(gripper, command, payload) is status


def test_a_tare_is_refused_while_a_part_is_held(gripper):
    assert gripper.do(Command.GRASP, 80.0, 200.0) is Status.SUCCESS
    assert raw(gripper, 0x38) is Status.ACCESS_DENIED


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


def test_wrong_crc_garbage_silence_and_reset_can_be_had(cell, gripper):
    cell.faults(wsg={"wrong_crc_next": 1, "garbage_next": 1})
    gripper.send(Command.WIDTH, 0, 0)
    gripper.send(Command.FORCE, 0, 0)
    assert gripper.reply(Command.FORCE).status is Status.SUCCESS
    cell.faults(wsg={"silent": True})
    gripper.sock.settimeout(0.2)
    with pytest.raises(TimeoutError):
        gripper.ask(Command.WIDTH, 0, 0)
    cell.faults(wsg={"silent": False, "reset_now": True})
    gripper.sock.settimeout(30.0)
    with pytest.raises(ConnectionError):
        gripper.reply(Command.LOOP)
