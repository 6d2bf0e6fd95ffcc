"""A gripper whose `close` hangs keeps no client alive, and one whose `close` raises hides no reason."""

import asyncio
import contextlib
from functools import partial
from types import SimpleNamespace

import pytest

from robot_client.cli import commission, home
from robot_client.cli.check import findings_of
from robot_client.cli.commission import Probing
from robot_client.grippers.dry_run.driver import DryGripper
from robot_client.ports import DriverError
from robot_client.session.travel import Errands
from robot_client.session.trial.gripper import try_empty, try_part
from robot_client.settings import Settings


def gripper_that(how, broken=None):
    """``broken``: it fails before, too."""

    class Leaving(DryGripper):
        async def connect(self):
            if broken:
                raise broken

        async def start(self, post):
            if broken:
                raise broken
            await super().start(post)

        async def width_mm(self):
            return 80.0

        async def home(self, _direction):
            return 80.0

        async def close(self):
            if how == "hangs":
                await asyncio.Event().wait()
            raise ConnectionResetError(104, "Connection reset by peer")

        def checks(self):
            async def read():
                if broken:
                    raise broken
                return []

            return {"gripper": read}

    return Leaving


async def an_errand(make):
    await Errands(None, make, *(None,) * 2, 1.0, 35.0).with_gripper(lambda gripper: gripper.width_mm())


async def a_homing(make):
    await home._home(SimpleNamespace(make_gripper=make), acknowledge=False, direction="default")


async def a_try(make, how=try_empty):
    await how(make, 1.0, print, *([print] if how is try_part else []))


def probing_with(make, tmp_path, monkeypatch):
    """A commissioning that asks the gripper whether it can grip at half the force."""

    async def answered(_settings):
        return SimpleNamespace(models=())

    monkeypatch.setattr(commission, "hello_of", answered)
    monkeypatch.setattr(commission, "with_grip", lambda settings, _grip_n: settings)
    monkeypatch.setattr(Settings, "make_gripper", lambda _settings: make())
    return Probing(Settings(), None, tmp_path)


async def a_question(make, tmp_path, monkeypatch):
    await probing_with(make, tmp_path, monkeypatch).allowed((40.0, 20.0))


async def a_leave(make, tmp_path, monkeypatch):
    probing = probing_with(make, tmp_path, monkeypatch)
    with contextlib.suppress(DriverError):
        await probing._kept.start(print)
    await probing.leave()


@pytest.fixture
def stories(tmp_path, monkeypatch):
    monkeypatch.setattr("robot_client.session.runner.CLOSING_S", 0.2)
    asked = {
        name: partial(story, tmp_path=tmp_path, monkeypatch=monkeypatch)
        for name, story in (("question", a_question), ("leave", a_leave))
    }
    return {"errand": an_errand, "homing": a_homing, "try": a_try, "try part": partial(a_try, how=try_part), **asked}


@pytest.mark.parametrize("how", ["hangs", "raises"])
async def test_a_gripper_that_does_not_close_keeps_no_check_from_its_findings(how, stories, monkeypatch):
    monkeypatch.setattr(Settings, "make_gripper", lambda _settings: gripper_that(how)())

    async def names():
        return [name async for name, _finding in findings_of(Settings())]

    assert {"plan", "service"} <= set(await asyncio.wait_for(names(), 10.0))


NAMES = ["errand", "homing", "try", "try part", "question", "leave"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("how", "named"), [("hangs", "gripper: its driver has not closed within 0.2 s"), ("raises", "reset by peer")]
)
async def test_a_gripper_that_does_not_close_is_a_failure_of_its_driver(name, how, named, stories):
    with pytest.raises(DriverError, match=named):
        await asyncio.wait_for(stories[name](gripper_that(how)), 5.0)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "leave"])
@pytest.mark.parametrize("how", ["hangs", "raises"])
async def test_a_gripper_that_does_not_close_hides_nothing_that_failed_before(name, how, stories):
    with pytest.raises(DriverError, match="fast stop"):
        await asyncio.wait_for(stories[name](gripper_that(how, DriverError("gripper: fast stop"))), 5.0)


@pytest.mark.parametrize("name", ["errand", "homing"])
async def test_an_interrupt_ends_a_client_whose_gripper_hangs(name, stories, monkeypatch):
    """The reason stays that it was interrupted."""
    make, moves = gripper_that("hangs"), asyncio.Event()

    async def never(_self, *_order):
        moves.set()
        await asyncio.Event().wait()

    for order in ("width_mm", "home"):
        monkeypatch.setattr(make, order, never)
    task = asyncio.ensure_future(stories[name](make))
    await asyncio.wait_for(moves.wait(), 5.0)
    task.cancel()
    with pytest.raises(DriverError, match="operator: interrupted"):
        await asyncio.wait_for(task, 5.0)
