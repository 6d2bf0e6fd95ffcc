"""What a person orders while the client asks the PLC counts before the next part begins."""

import asyncio
from types import SimpleNamespace

import pytest

from robot_client.insertion.geometry import WorkPose
from robot_client.ports import DriverError
from robot_client.session.cycle import Cycle, CycleSettings
from robot_client.session.handshake import Handshake, HandshakeSettings

TAUGHT = CycleSettings(pick=WorkPose(x_mm=0.0, y_mm=0.0, z_mm=45.0, yaw_deg=0.0), open_mm=80.0)


class Signals:
    """A PLC whose start comes on as it is read; a person orders something in the same moment."""

    def __init__(self, order):
        self.order, self.reads_n = order, 0

    async def read_signal(self, name):
        self.reads_n += name == "diTactileStart"
        if self.reads_n == 3:
            self.order()
        return self.reads_n >= 3

    async def write_signal(self, name, *, on):
        pass

    async def close(self):
        pass


@pytest.mark.parametrize("word", ["pause", "stop"])
def test_no_part_is_picked_after_an_order_that_came_together_with_the_plcs_start(word):
    went = []

    async def go(way):
        went.append(way)

    async def is_empty(_work):
        return True

    async def story():
        signals = Signals(lambda: cycle.pace.order(word))
        errands = SimpleNamespace(go=go, with_gripper=is_empty)
        cycle = Cycle(TAUGHT, errands, None, lambda _text: None, plc=Handshake(HandshakeSettings(), signals))
        task = asyncio.ensure_future(cycle.run(None))
        await asyncio.wait({task}, timeout=2.0)
        assert signals.reads_n >= 3
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(story())
    assert went == []


class LostController(Signals):
    """Signals of a controller that answers no more once it is lost."""

    lost = False

    async def write_signal(self, _name, *, on):  # noqa: ARG002 the port's signature
        if self.lost:
            raise DriverError("POST /rw/iosystem/signals: ConnectError")


def test_a_controller_that_answers_no_more_does_not_hide_why_the_cycle_ended():
    lines = []

    async def story():
        async def is_empty(_work):
            return True

        async def insert(_number):
            signals.lost = True
            raise DriverError("arm: silent: no new datagram for 300 ms")

        errands = SimpleNamespace(go=lambda _way: asyncio.sleep(0), with_gripper=is_empty, clear_mm=35.0)
        signals = LostController(lambda: None)
        cycle = Cycle(TAUGHT, errands, insert, lines.append, plc=Handshake(HandshakeSettings(), signals))
        await cycle.run(None)

    with pytest.raises(DriverError, match="arm: silent"):
        asyncio.run(story())
    assert lines[-1].startswith("the PLC may not know of the fault: POST")
