"""The gripper's text mode: the same grasp, the same losses noticed, the same refusals."""

import asyncio
import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.cli.home import _home
from robot_client.grippers.wsg50.gripper import GripperError
from robot_client.grippers.wsg50.settings import Settings
from robot_client.grippers.wsg50.text import LineParser, TextWsg50, encode_call
from robot_client.insertion.events import Failure, Grasped, PartLost, Width
from robot_client.settings import load_settings


class TextGripper:
    """A peer that grips what is there."""

    def __init__(self, state=0, part=True, homes=True):
        self.state, self.part, self.calls, self.mute, self.writer = state, part, [], False, None
        self.homes = homes

    async def handle(self, reader, writer):
        self.writer = writer
        sender = asyncio.create_task(self.send(writer))
        with contextlib.suppress(ConnectionError):
            while line := (await reader.readline()).decode().strip():
                self.calls.append(line)
                name = line.split("(")[0]
                writer.write(f"ACK {name}\n".encode())
                if name == "HOME":
                    self.state = 0
                    writer.write(b"FIN HOME\n" if self.homes else b"ERR HOME 29\n")
                if name == "FSACK":
                    self.state = 0
                if name == "GRIP":
                    self.state = 4 if self.part else 2
                    writer.write(b"FIN GRIP\n" if self.part else b"ERR GRIP 18\n")
        sender.cancel()
        writer.close()

    async def send(self, writer):
        while True:
            if not self.mute:
                writer.write(f"@GRIPSTATE={self.state}\n@POS=50.00\n".encode())
            await asyncio.sleep(0.02)


@contextlib.asynccontextmanager
async def connected(**options):
    peer = TextGripper(**options)
    server = await asyncio.start_server(peer.handle, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    gripper = TextWsg50(Settings(host="127.0.0.1", port=port, silence_s=0.3, reply_timeout_s=20.0))
    events = asyncio.Queue()
    try:
        await gripper.start(events.put_nowait)
        yield peer, gripper, events
    finally:
        await gripper.close()
        server.close()
        await asyncio.sleep(0.02)


def first_event(act, **options):
    async def story():
        async with connected(**options) as (peer, gripper, events):
            act(peer, gripper)
            while isinstance(event := await asyncio.wait_for(events.get(), 30.0), Width):
                pass
            return event, peer

    return asyncio.run(story())


def test_it_grips_with_the_force_limit_and_reports_the_width():
    event, peer = first_event(lambda _, gripper: gripper.grasp())
    assert isinstance(event, Grasped)
    assert event.width_mm == 50.0
    assert "GRIP(40,40,30)" in peer.calls
    assert peer.calls[-1] == "BYE()"
    assert not {"FSACK()", "HOME()", "STOP()", "FASTSTOP()"} & set(peer.calls)


def test_a_held_part_is_accepted_as_it_is():
    event, peer = first_event(lambda _, gripper: gripper.grasp(), state=4)
    assert isinstance(event, Grasped)
    assert not [call for call in peer.calls if call.startswith("GRIP")]


@pytest.mark.parametrize(
    ("change", "expect"),
    [({"state": 3}, PartLost), ({"state": 7}, Failure), ({"state": 0}, Failure), ({"mute": True}, Failure)],
)
def test_losses_are_noticed(change, expect):
    event, _ = first_event(lambda peer, _: peer.__dict__.update(change), state=4)
    assert isinstance(event, expect)


def test_no_part_and_a_cut_connection_are_failures():
    event, _ = first_event(lambda _, gripper: gripper.grasp(), part=False)
    assert "ERR GRIP" in event.detail
    event, _ = first_event(lambda peer, _: peer.writer.close(), state=4)
    assert event.code == "link"


def test_a_latched_error_stops_the_start():
    with pytest.raises(GripperError, match="ERROR"):
        first_event(lambda *_: None, state=7)


def operate(act, **options):
    """What ``act(settings)`` gives against a gripper in text mode, and the calls that it saw."""

    async def story():
        peer = TextGripper(**options)
        server = await asyncio.start_server(peer.handle, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        gripper = {"protocol": "text", "host": "127.0.0.1", "port": port, "reply_timeout_s": 20.0}
        try:
            return await act(load_settings(None, {"gripper": gripper})), peer.calls
        finally:
            await asyncio.sleep(0.02)
            server.close()

    return asyncio.run(story())


def homing(acknowledge, direction="default"):
    return lambda settings: _home(settings, acknowledge=acknowledge, direction=direction)


def test_home_references_the_gripper_and_acknowledges_only_on_request(capsys):
    outcome, calls = operate(homing(acknowledge=False))
    assert (outcome.done, "HOME()" in calls, "FSACK()" in calls) == (True, True, False)
    _, calls = operate(homing(acknowledge=True), state=7)
    assert [call for call in calls if call in ("FSACK()", "HOME()")] == ["FSACK()", "HOME()"]
    assert "homed, width 50.0 mm" in capsys.readouterr().out


def test_home_refuses_to_drop_a_part_and_what_text_mode_does_not_know():
    with pytest.raises(GripperError, match="would drop"):
        operate(homing(acknowledge=False), state=4)
    with pytest.raises(GripperError, match="one homing direction"):
        operate(homing(acknowledge=False, direction="inward"))
    with pytest.raises(GripperError, match="ERR HOME"):
        operate(homing(acknowledge=False), homes=False)


async def checked(settings):
    gripper = settings.make_gripper()
    findings = await gripper.checks()["gripper"]()
    await gripper.close()
    return findings


@pytest.mark.parametrize(("state", "good"), [(4, True), (7, False)])
def test_check_reads_a_gripper_in_text_mode_and_moves_nothing(state, good):
    findings, calls = operate(checked, state=state)
    assert all(ready for ready, _ in findings) == good
    assert any("width 50.0 mm" in text for _, text in findings)
    assert {call.split("(")[0] for call in calls} == {"AUTOSEND", "BYE"}


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_non_finite_numbers_are_never_sent(bad):
    with pytest.raises(GripperError, match="finite"):
        encode_call("GRIP", bad)


@given(st.lists(st.binary(max_size=300), max_size=10))
def test_random_bytes_do_no_harm(chunks):
    parser, gripper = LineParser(), TextWsg50(Settings())
    for chunk in chunks:
        for line in parser.feed(chunk):
            gripper._on_line(line)
    assert len(parser._rest) <= 256
