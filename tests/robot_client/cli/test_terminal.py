"""Terminal and disk may be gone or take nothing more: the arm is guided on, and every signal is heard."""

import asyncio
import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from robot_client.cli import terminal
from robot_client.session import recorder
from robot_client.session.recorder import Recorder, read_log
from tests.robot_client.insertion.stories import PLAN, TO_ARMING


@contextlib.contextmanager
def taking_nothing():
    """Text to write to: a pipe that takes nothing before an event is set, and what has come out once it is closed."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writing, b" " * 4096)
    takes, came = threading.Event(), []

    def take():
        takes.wait(10.0)
        takes.set()
        with os.fdopen(reading, encoding="utf-8") as end:
            came.append(end.read().lstrip())

    reader = threading.Thread(target=take)
    reader.start()
    text = os.fdopen(writing, "w", encoding="utf-8", buffering=1)
    try:
        yield text, takes, came
    finally:
        takes.set()
        reader.join(20.0)


def test_a_terminal_that_takes_no_more_lines_does_not_keep_the_arm_from_being_guided(monkeypatch):
    """As after Ctrl-S, or with a pager at its end."""

    async def story():
        for text in ("first", "second"):
            terminal.show(text)
        return takes.is_set()

    with taking_nothing() as (text, takes, came):
        monkeypatch.setattr(sys, "stdout", text)
        waited = asyncio.run(story())
        takes.set()
        terminal.printed()
        text.close()
    assert not waited
    assert came == ["first\nsecond\n"]


@pytest.mark.parametrize("ends", [True, False])
def test_a_disk_that_does_not_answer_does_not_keep_the_arm_from_being_guided(tmp_path, monkeypatch, ends):
    """Nor the end of the insertion; its log is whole as soon as the disk has it."""
    monkeypatch.setattr(recorder, "LAST_LINES_S", 10.0 if ends else 0.01)
    path = tmp_path / "log.jsonl"
    with taking_nothing() as (text, takes, came):
        monkeypatch.setattr(Path, "open", lambda *_arguments, **_options: text)
        log = Recorder(path, PLAN)
        for event in TO_ARMING[:1] * 100:
            log.event(event)
        waited = takes.is_set()
        if ends:
            takes.set()
        log.end({})
        log.event(TO_ARMING[0])  # of a driver that tells something after it was closed
        waited = waited or takes.is_set() != ends
    monkeypatch.undo()
    assert not waited
    assert bool(log.lost) == (not ends)
    path.write_text(came[0])
    assert len(read_log(path)[1]) == 100


UNANSWERED = """
import os
from pathlib import Path
from robot_client.session import recorder
from tests.robot_client.insertion.stories import PLAN

reading, writing = os.pipe()
os.set_blocking(writing, False)
try:
    while os.write(writing, b" " * 4096):
        pass
except BlockingIOError:
    os.set_blocking(writing, True)
Path.open = lambda *_arguments, **_options: os.fdopen(writing, "w", buffering=1)
recorder.LAST_LINES_S = 0.1
log = recorder.Recorder(Path("log.jsonl"), PLAN)
log.end({})
print(log.lost)
"""


def test_a_client_does_not_outlive_its_insertion_for_a_disk_that_does_not_answer():
    ended = subprocess.run(
        [sys.executable, "-c", UNANSWERED], stdout=subprocess.PIPE, text=True, timeout=30, check=True
    )
    assert ended.stdout == "the disk has not taken its last lines within 0.1 s\n"


def test_figures_that_no_log_can_hold_end_the_log_and_not_the_insertion(tmp_path):
    """As of a driver that keeps its statistics in types of its own."""
    log = Recorder(tmp_path / "log.jsonl", PLAN)
    log.end({"link": {"worst_ms": float("nan"), "times": object()}})
    assert log.lost
    assert read_log(log.path)[2] == {}


def test_an_insertion_ends_as_it_would_have_where_nobody_reads_its_lines(tmp_path):
    arguments = [sys.executable, "-m", "robot_client", "insert", "--x-mm", "8", "--log", str(tmp_path / "log.jsonl")]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as client:
        client.stdout.close()
        errors = client.stderr.read()
    assert (client.returncode, errors) == (0, "")


@pytest.mark.parametrize("ignored", [False, True])
def test_a_terminal_that_hangs_up_ends_the_insertion_in_order_but_under_nohup(ignored):
    async def wait():
        terminal.stop_on_signals()
        os.kill(os.getpid(), signal.SIGHUP)
        await asyncio.sleep(0.05)
        return "went on"

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.default_int_handler)
    try:
        if ignored:
            assert asyncio.run(wait()) == "went on"
        else:
            with pytest.raises(asyncio.CancelledError):
                asyncio.run(wait())
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("order", [signal.SIGUSR1, signal.SIGUSR2, signal.SIGRTMIN])
def test_an_order_that_only_a_cycle_takes_ends_another_command_in_order(order):
    async def wait():
        terminal.stop_on_signals()
        os.kill(os.getpid(), order)
        await asyncio.sleep(0.05)

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(wait())
