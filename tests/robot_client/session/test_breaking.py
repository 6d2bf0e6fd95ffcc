"""What keeps an insertion from starting, or breaks it: it holds the arm, and log and service get the reason."""

import asyncio

import pytest

from robot_client.insertion.events import Failure
from robot_client.ports import DriverError
from robot_client.session.recorder import Recorder, read_log
from robot_client.session.report import Report
from robot_client.session.runner import Observer
from tests.robot_client.insertion.stories import PLAN
from tests.robot_client.session.test_runner import let_close, runner


async def broken_off(run, path):
    """How it ended, and the end of its log."""
    run.recorder = Recorder(path, PLAN)
    let_close(run)
    (ended,) = await asyncio.wait_for(asyncio.gather(run.run(), return_exceptions=True), 5.0)
    return ended, read_log(path)[2]


@pytest.mark.parametrize("port", ["service", "gripper", "arm"])
async def test_a_device_that_does_not_get_ready_is_the_reason_in_the_log(port, tmp_path):
    run, sent = runner([]), []

    async def start(_post):
        raise DriverError(f"{port}: not ready, homed or reachable")

    getattr(run, port).start = start
    run.service.send = sent.append
    ended, end = await broken_off(run, tmp_path / "episode.jsonl")
    assert str(ended) == f"{port}: not ready, homed or reachable"
    assert (end["phase"], end["reason"]) == ("failed", f"client: not_ready: {ended}")
    assert sent == []  # nothing was opened, so nothing is given up


class Breaks(Observer):
    """As one of a defect of ours; it breaks on whatever comes."""

    def on_event(self, _state, _event):
        raise ZeroDivisionError("no attempt")


@pytest.mark.parametrize("breaks", ["arm", "observer"])
async def test_an_insertion_that_breaks_is_held_and_given_up_with_its_reason(breaks, tmp_path):
    notes, sent = [], []
    run = runner(notes, (Breaks(),) if breaks == "observer" else ())
    run.service.send = sent.append
    if breaks == "arm":
        run.arm.position = lambda: {}["tcp"]
    ended, end = await broken_off(run, tmp_path / "episode.jsonl")
    assert isinstance(ended, KeyError if breaks == "arm" else ZeroDivisionError)
    assert notes.index("hold arm") < notes.index("stopping arm")
    (abort,) = (message for message in sent if message.type == "abort")
    assert abort.reason == end["reason"]
    assert end["reason"].startswith(f"client: broken: {type(ended).__name__}")
    assert abort.cause == "client"


async def test_the_log_ends_with_where_the_arm_came_to_rest(tmp_path):
    """After the farewell: it has moved on since its last event."""
    run = runner([])
    close = run.arm.close

    async def stopping():
        run.arm.position = lambda: PLAN.approach.at_height(33.21049)
        return await close()

    run.arm.close = stopping
    task = asyncio.ensure_future(broken_off(run, tmp_path / "episode.jsonl"))
    await asyncio.sleep(0.05)
    run.post(Failure(at_s=0.0, source="service", code="link", detail="gone"))
    _, end = await task
    assert end["rest"] == {**PLAN.approach.model_dump(), "z_mm": 33.21}
    line = next(line for line in Report(None, print).final(run.state, "", {}, end["rest"]) if "rest" in line)
    assert line.startswith("  rest        x_mm 8.0, y_mm 0.0, z_mm 33.21")
