"""A lost answer of the controller ends no cycle that waits for the PLC; one that stays lost does, as in all else."""

import time

import pytest

from robot_client.ports import DriverError
from robot_client.session import handshake
from robot_client.session.handshake import Handshake, HandshakeSettings
from tests.robot_client.cycle_cell import SIGNALS
from tests.robot_client.live_cell import bench

NAMES = HandshakeSettings()


class Losing:
    """The controller's signals; the next answers are lost."""

    def __init__(self):
        self.levels, self.lost_n, self.asked_n = dict.fromkeys(SIGNALS, False), 0, 0

    async def read_signal(self, name):
        self._ask()
        return self.levels[name]

    async def write_signal(self, name, *, on):
        self._ask()
        self.levels[name] = on

    def _ask(self):
        self.asked_n += 1
        if self.lost_n:
            self.lost_n -= 1
            raise DriverError("GET /rw/iosystem/signals: ReadTimeout")


@pytest.mark.parametrize("fault", ["refuse_next", "reset_next", "garbage_next"])
async def test_one_lost_answer_of_the_web_services_while_nothing_moves_ends_no_cycle(fault):
    async with bench() as cell:
        cell.cabinet.signals |= dict.fromkeys(SIGNALS, 0.0)
        plc = Handshake(NAMES, cell.settings.make_arm().signals())
        await plc.begin()
        for requested in (False, False, True):
            cell.cabinet.signals[NAMES.start] = float(requested)
            cell.board.update({"rws": {fault: 1}})
            assert await plc.asked(ready=True) == requested
            assert cell.cabinet.signals[NAMES.ready] == 1.0
        await plc.end(fault=False)


@pytest.mark.parametrize("lost_n", [1, 2, 3])
async def test_whichever_answer_is_lost_is_asked_for_again(lost_n):
    signals = Losing()
    plc = Handshake(NAMES, signals)
    await plc.begin()
    signals.lost_n, before_n = lost_n, signals.asked_n
    assert not await plc.asked(ready=True)
    assert signals.asked_n - before_n == 3 + lost_n


async def test_answers_that_stay_lost_end_the_cycle(monkeypatch):
    monkeypatch.setattr(handshake, "LOST_S", 0.3)
    signals = Losing()
    plc = Handshake(NAMES, signals)
    await plc.begin()
    signals.lost_n, began_s = 1000, time.monotonic()
    with pytest.raises(DriverError, match="ReadTimeout"):
        await plc.asked(ready=True)
    assert time.monotonic() - began_s >= 0.3


@pytest.mark.parametrize("step", ["begin", "busy", "done"])
async def test_no_other_step_waits_for_a_lost_answer(step):
    """A wrong name is refused at once, and a PLC that may have missed a level is never guessed at."""
    signals = Losing()
    plc = Handshake(NAMES, signals)
    signals.lost_n = 1
    with pytest.raises(DriverError, match="ReadTimeout"):
        await getattr(plc, step)()
    assert signals.asked_n == 1


async def test_a_request_before_ready_is_refused_at_once():
    signals = Losing()
    plc = Handshake(NAMES, signals)
    await plc.begin()
    signals.levels[NAMES.start] = True
    asked_n = signals.asked_n
    with pytest.raises(DriverError, match="diTactileStart is on before doTactileReady"):
        await plc.asked(ready=True)
    assert signals.asked_n == asked_n + 1
