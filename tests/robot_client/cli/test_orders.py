"""The orders of a running `cycle`: typed in the terminal, or sent as signals."""

import asyncio
import os
import pty
import signal
import subprocess
import sys

from robot_client.cli.cycle import _take_orders
from robot_client.cli.terminal import printed
from robot_client.session.cycle import Pace

SHELL = """
import fcntl, subprocess, sys, termios, time
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
subprocess.Popen([sys.executable, "-c", sys.argv[1]], process_group=0)
time.sleep(30.0)
"""
IN_THE_BACKGROUND = """
import asyncio
from robot_client.cli.cycle import _take_orders
from robot_client.session.cycle import Pace
async def story():
    _take_orders(Pace())
    for _ in range(200):
        print("goes on", flush=True)
        await asyncio.sleep(0.05)
asyncio.run(story())
"""


def heard(master, words, times_n=1):
    """What a terminal prints until it has said so."""
    printed = b""
    while printed.count(words) < times_n:
        printed += os.read(master, 4096)
    return printed


def test_in_the_background_of_a_shell_in_which_somebody_types_it_goes_on():
    master, slave = pty.openpty()
    arguments = [sys.executable, "-c", SHELL, IN_THE_BACKGROUND]
    with subprocess.Popen(arguments, stdin=slave, stdout=slave, stderr=slave, start_new_session=True) as shell:
        os.close(slave)
        heard(master, b"goes on")
        os.write(master, b"ls\n")
        shown = heard(master, b"goes on", 8)
        assert b"Traceback" not in shown
        assert b"no orders are read from the terminal any more" in shown
        shell.kill()
    os.close(master)


TYPED = """
import asyncio
from robot_client.cli.cycle import _take_orders
from robot_client.session.cycle import Pace
async def story():
    pace = Pace()
    _take_orders(pace)
    print("ready", flush=True)
    while not pace.ending:
        await asyncio.sleep(0.05)
    print("ended", flush=True)
asyncio.run(story())
"""


def test_a_half_typed_order_does_not_keep_the_event_loop_from_guiding_the_arm():
    master, slave = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", TYPED], stdin=slave, stdout=slave, stderr=slave) as client:
        os.close(slave)
        heard(master, b"ready")
        os.write(master, b"pa\x04")
        heard(master, b"expected pause, resume or stop")
        os.write(master, b"stop\n")
        heard(master, b"ended")
        assert client.wait(60) == 0
    os.close(master)


def test_after_the_end_of_what_is_typed_it_says_which_signals_are_orders():
    master, slave = pty.openpty()
    with subprocess.Popen([sys.executable, "-c", TYPED], stdin=slave, stdout=slave, stderr=slave) as client:
        os.close(slave)
        heard(master, b"ready")
        os.write(master, b"\x04")
        shown = heard(master, b"SIGINT holds").split()
        for words in ("SIGUSR1 pauses", "SIGRTMIN resumes", "SIGUSR2 stops", "SIGINT holds", f"process {client.pid}"):
            assert words.encode() in b" ".join(shown)
        client.send_signal(signal.SIGUSR2)
        heard(master, b"ended")
        assert client.wait(60) == 0
    os.close(master)


def test_a_pause_that_is_sent_twice_does_not_resume(capsys):
    async def story():
        pace, states = Pace(), []
        _take_orders(pace)
        for number in (signal.SIGUSR1, signal.SIGUSR1, signal.SIGRTMIN, signal.SIGRTMIN, signal.SIGUSR2):
            os.kill(os.getpid(), number)
            await asyncio.sleep(0.05)
            states.append((pace.paused, pace.ending))
        return states

    before = signal.getsignal(signal.SIGTTIN)
    try:
        states = asyncio.run(story())
    finally:
        signal.signal(signal.SIGTTIN, before)
    printed()
    assert states == [(True, False), (True, False), (False, False), (False, False), (False, True)]
    assert capsys.readouterr().out.splitlines()[-1] == "stopping after this part"
