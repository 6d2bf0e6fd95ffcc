"""The WSG-50 codec against the vendor's and third parties' bytes, and against anything at all."""

import contextlib
import struct
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_client.grippers.wsg50 import codec, codes
from robot_client.grippers.wsg50.codec import Frame, StreamParser, WsgError
from robot_client.grippers.wsg50.codes import Command, GraspingState, MoveFlag, Status, SystemState
from tests.kept import is_as_kept

LIMITS = (10.0, 100.0, 400.0, 1.0, 10.0, 11.0, 30.0, 40.0)
REQUESTS = [
    ("AA AA AA 24 03 00 61 63 6B DC B9", Command.ACKNOWLEDGE, (b"ack",)),
    ("AA AA AA 20 01 00 00 8F 83", Command.HOMING, (0,)),
    ("AA AA AA 20 01 00 01 AE 93", Command.HOMING, (1,)),
    ("AA AA AA 20 01 00 02 CD A3", Command.HOMING, (2,)),
    ("AA AA AA 30 04 00 00 00 16 43 DE CD", Command.SET_ACCELERATION, (150.0,)),
    ("AA AA AA 32 04 00 00 00 A0 41 F5 22", Command.SET_FORCE_LIMIT, (20.0,)),
    ("AA AA AA 21 09 00 02 00 00 70 42 00 00 48 42 72 DB", Command.MOVE, (MoveFlag.STOP_ON_BLOCK, 60.0, 50.0)),
    ("AA AA AA 21 09 00 00 00 00 A0 42 00 00 F0 41 80 38", Command.MOVE, (MoveFlag.CLAMP_ON_BLOCK, 80.0, 30.0)),
    ("AA AA AA 25 08 00 00 00 20 42 00 00 A0 41 38 28", Command.GRASP, (40.0, 20.0)),
    ("AA AA AA 25 08 00 00 00 78 42 00 00 48 43 27 16", Command.GRASP, (62.0, 200.0)),
    ("AA AA AA 26 08 00 00 00 70 42 00 00 A0 41 1F 1E", Command.RELEASE, (60.0, 20.0)),
    ("AA AA AA 43 03 00 00 00 00 B8 10", Command.WIDTH, (0, 0)),
    ("AA AA AA 41 03 00 00 00 00 DE 42", Command.GRASPING_STATE, (0, 0)),
    ("AA AA AA 40 03 00 00 00 00 F5 70", Command.SYSTEM_STATE, (0, 0)),
    ("AA AA AA 22 00 00 0E 76", Command.STOP, ()),
    ("AA AA AA 07 00 00 35 4C", Command.DISCONNECT, ()),
    ("AA AA AA 23 00 00 AC 1C", Command.FAST_STOP, ()),
    ("AA AA AA 44 03 00 00 00 00 3C D1", Command.SPEED, (0, 0)),
    ("AA AA AA 45 03 00 00 00 00 17 E3", Command.FORCE, (0, 0)),
    ("AA AA AA 43 03 00 01 14 00 36 8D", Command.WIDTH, (1, 20)),
]
REPLIES = [
    ("AA AA AA 20 02 00 00 00 B3 FD", 0x20, Status.SUCCESS, ()),
    ("AA AA AA 90 02 00 0E 00 FD 02", 0x90, Status.CMD_UNKNOWN, ()),
    ("AA AA AA 21 02 00 1A 00 67 CB", 0x21, Status.CMD_PENDING, ()),
    ("AA AA AA 21 02 00 00 00 28 04", 0x21, Status.SUCCESS, ()),
    ("AA AA AA 21 02 00 05 00 37 E1", 0x21, Status.FEATURE_NOT_SUPPORTED, ()),
    ("AA AA AA 24 02 00 00 00 B9 7E", 0x24, Status.SUCCESS, ()),
    ("AA AA AA 40 06 00 00 00 00 00 00 00 A7 28", 0x40, Status.SUCCESS, (0,)),
    ("AA AA AA 41 03 00 00 00 00 DE 42", 0x41, Status.SUCCESS, (0,)),
    ("AA AA AA 43 06 00 00 00 00 00 20 41 C8 9B", 0x43, Status.SUCCESS, (10.0,)),
    (f"AA AA AA 53 22 00 00 00 {struct.pack('<8f', *LIMITS).hex(' ')} 75 30", 0x53, Status.SUCCESS, LIMITS),
    ("AA AA AA 22 02 00 00 00 A7 2E", 0x22, Status.SUCCESS, ()),
    ("AA AA AA 25 02 00 1A 00 6D 48", 0x25, Status.CMD_PENDING, ()),
    ("AA AA AA 25 02 00 00 00 22 87", 0x25, Status.SUCCESS, ()),
    ("AA AA AA 25 02 00 12 00 E4 C9", 0x25, Status.CMD_FAILED, ()),
    ("AA AA AA 21 02 00 1D 00 DE 46", 0x21, Status.AXIS_BLOCKED, ()),
    ("AA AA AA 21 02 00 13 00 BD 7E", 0x21, Status.CMD_ABORTED, ()),
    ("AA AA AA 21 02 00 10 00 48 22", 0x21, Status.ACCESS_DENIED, ()),
]
RAW = [
    ("AA AA AA 01 00 00 E8 10", 0x01, ""),
    ("AA AA AA 01 02 00 12 34 6D 66", 0x01, "12 34"),
    ("AA AA AA 30 06 00 00 00 00 00 16 43 DC CB", 0x30, "00 00 00 00 16 43"),
]


def test_the_crc_is_the_one_of_the_vendor_and_not_a_catalogue_one():
    assert codec.crc16(b"123456789") == 0x6EB4
    assert codec.crc16(b"\xaa\xaa\xaa") == 0x50F5


@pytest.mark.parametrize(("text", "command", "payload"), RAW)
def test_vendor_frames_encode_and_parse(text, command, payload):
    wire = bytes.fromhex(text)
    assert codec.encode_frame(command, bytes.fromhex(payload)) == wire
    assert StreamParser().feed(wire) == [Frame(command, bytes.fromhex(payload))]
    assert codec.crc16(wire) == 0


@pytest.mark.parametrize(("text", "command", "values"), REQUESTS)
def test_request_vectors_hold_in_both_directions(text, command, values):
    wire = bytes.fromhex(text)
    assert codec.encode_request(command, *values) == wire
    (frame,) = StreamParser().feed(wire)
    request = codec.decode_request(frame)
    assert (request.command, request.values) == (command, values)


@pytest.mark.parametrize(("text", "command", "status", "values"), REPLIES)
def test_reply_vectors_hold_in_both_directions(text, command, status, values):
    wire = bytes.fromhex(text)
    (frame,) = StreamParser().feed(wire)
    reply = codec.decode_reply(frame)
    assert (reply.command, reply.status, reply.values) == (command, status, values)
    assert codec.encode_reply(command, status, *values) == wire


@given(st.binary(max_size=400), st.integers(0, 0xA9), st.binary(max_size=40))
def test_a_frame_is_found_after_any_garbage_that_holds_no_preamble(garbage, command, payload):
    garbage = garbage.replace(b"\xaa\xaa\xaa", b"").rstrip(b"\xaa")
    garbage = garbage.replace(b"\xaa\xaa\xaa", b"")
    wire = codec.encode_frame(command, payload)
    assert StreamParser().feed(garbage + wire)[-1:] == [Frame(command, payload)]


def test_a_header_longer_than_any_frame_hides_no_frame_after_it():
    too_long = codec.PREAMBLE + struct.pack("<BH", Command.MOVE, codec.MAX_PAYLOAD_BYTES + 1)
    assert StreamParser().feed(too_long + codec.encode_frame(Command.STOP, b"")) == [Frame(Command.STOP, b"")]


@given(st.lists(st.tuples(st.integers(0, 0xA9), st.binary(max_size=30)), max_size=6), st.data())
def test_segmentation_changes_nothing(frames, data):
    wire = b"".join(codec.encode_frame(*frame) for frame in frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(wire)), max_size=8)))
    parser = StreamParser()
    frames_read = [f for a, b in zip([0, *cuts], [*cuts, len(wire)], strict=True) for f in parser.feed(wire[a:b])]
    assert [(f.command, f.payload) for f in frames_read] == frames


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_random_bytes_never_raise_and_never_grow_the_buffer(chunks):
    parser = StreamParser()
    for chunk in chunks:
        parser.feed(chunk)
    assert len(parser._buffer) <= codec.MAX_PAYLOAD_BYTES + 8 + 200


def test_one_flipped_bit_anywhere_leaves_no_frame():
    whole = codec.encode_request(Command.MOVE, 0, 60.0, 50.0)
    for index, bit in product(range(len(whole)), range(8)):
        wire = bytearray(whole)
        wire[index] ^= 1 << bit
        assert StreamParser().feed(bytes(wire)) == [], f"bit {bit} of byte {index}"


@settings(max_examples=300)
@given(st.integers(0, 255), st.binary(max_size=64))
def test_decoders_answer_or_refuse_any_payload(command, payload):
    for decode in (codec.decode_request, codec.decode_reply):
        with contextlib.suppress(WsgError):
            decode(Frame(command, payload))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e60])
def test_non_finite_values_are_refused_in_both_directions(value):
    with pytest.raises(WsgError):
        codec.encode_request(Command.GRASP, value, 10.0)
    if value != 1e60:
        with pytest.raises(WsgError):
            codec.decode_request(Frame(Command.GRASP, struct.pack("<ff", value, 10.0)))


@pytest.mark.parametrize("flags", [0x01, 0x03, 0x04, 0xFF])
def test_the_ambiguous_relative_bit_is_never_sent(flags):
    with pytest.raises(WsgError, match="expected 0x00"):
        codec.encode_request(Command.MOVE, flags, 60.0, 50.0)


def test_the_states_of_a_grasp_have_the_numbers_of_the_manual():
    names = ["IDLE", "GRASPING", "NO_PART", "PART_LOST", "HOLDING", "RELEASING", "POSITIONING", "ERROR"]
    assert [GraspingState(number).name for number in range(8)] == names


@pytest.mark.parametrize("table", [codes.Status, codes.Command, codes.HomingDirection, codes.UpdateFlag, SystemState])
def test_the_protocols_numbers_stay_as_they_are(table):
    is_as_kept(__file__, table.__name__, {entry.name: int(entry) for entry in table})


@pytest.mark.parametrize("bit", SystemState)
def test_a_state_is_a_fault_where_the_manual_says_that_it_stops_the_fingers(bit):
    names = {"FAST_STOP", "TEMP_FAULT", "POWER_FAULT", "CURRENT_FAULT", "FINGER_FAULT"}
    assert bool(bit & codes.FAULT_BITS) == (bit.name in names)


def test_an_id_is_one_byte_and_a_payload_no_longer_than_a_frame_holds():
    for command, payload in ((0, b""), (255, bytes(codec.MAX_PAYLOAD_BYTES))):
        codec.encode_frame(command, payload)
    for command, payload in ((-1, b""), (256, b""), (1, bytes(codec.MAX_PAYLOAD_BYTES + 1))):
        with pytest.raises(codec.WsgError, match="frame id"):
            codec.encode_frame(command, payload)
