"""The whole cycle against emulated devices over real sockets: nothing is released in a wrong place."""

import asyncio
import itertools
import math
from collections import Counter
from functools import partial

import pytest

from robot_client.cli.insert import make_plan
from robot_client.insertion.pace import ONE_SPEED
from robot_client.insertion.state import Phase
from robot_client.ports import DriverError
from robot_client.session.afresh import upright
from robot_client.session.cycle import CycleHeldError, Pace
from robot_client.session.handshake import HandshakeSettings
from service.contract import wire
from tests.robot_client.cycle_cell import (
    PICK,
    REJECT,
    RETREAT_MM,
    SIGNALS,
    cell_with,
    cycle_of,
    fixture,
    insertion,
    is_in,
    run,
    turned,
)
from tests.robot_client.insertion.stories import RAMPS
from tests.robot_client.live_cell import bench, undisturbed
from tests.waiting import until


def fastest_mm_s(trace, seconds=1.0):
    """Largest downward speed of the arm since the beginning of a trace, each over a tenth of a second."""
    (begin_s, _, _), *_ = trace
    way = [(at_s, pose.position_mm[2]) for at_s, _, pose in trace if at_s < begin_s + seconds]
    steps = [
        (before, next((now for now in way[k:] if now[0] >= before[0] + 0.1), None)) for k, before in enumerate(way)
    ]
    return max((high - low) / (then_s - now_s) for (now_s, high), now in steps if now for then_s, low in [now])


@pytest.mark.parametrize("parts_n", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_parts_are_picked_inserted_and_let_go_in_order(parts_n):
    async def work():
        async with cell_with(seed=10) as (cell, part):  # the first goes in at once, the second needs a correction
            lines = []
            count = await cycle_of(cell, lines).run(parts_n)
            return count, part.left, lines, cell.trace

    count, left, lines, trace = undisturbed(work, 110.0)
    assert count.inserted_n == parts_n
    assert [is_in(one) for one in left] == [True] * parts_n
    assert lines[-1].endswith(f"{parts_n} inserted")
    last = [pose.position_mm for _, _, pose in trace][-400:]
    low = min(at[2] for at in last)
    column = [at for at in last if at[2] < low + 25.0]
    assert max(abs(at[0] - column[0][0]) for at in column) < 0.2, "it retreats along the vertical"
    way = [pose.position_mm for _, _, pose in trace]
    aside = [b for a, b in itertools.pairwise(way) if b[0] < PICK.x_mm / 2 and math.dist(a[:2], b[:2]) > 0.02]
    assert min(at[2] for at in aside) > PICK.z_mm + RETREAT_MM - 0.5, "into its fixture and out of it from above"


@pytest.mark.slow
def test_a_part_that_has_turned_in_the_hand_is_taken_afresh_and_tried_again_more_slowly_where_it_stood():
    async def work():
        async with cell_with() as (cell, part):
            armed, speeds, refused_at, descents = [], [], [], []

            def refuse_once(message):
                if isinstance(message, wire.Descending):
                    speeds.append(message.speed_mm_s)
                    descents.append(len(cell.trace))
                if isinstance(message, wire.Arm):
                    armed.append((message.insertion_id, message.attempt, cell.cabinet.arm.pose.position_mm[0]))
                    if len(armed) == 2:
                        refused_at.append(len(cell.trace))
                        return [turned(message)]
                return None

            cell.service.on_message = refuse_once
            place, one_speed = fixture(cell), {"pace": ONE_SPEED, "ramps": RAMPS}
            plan = make_plan(cell.settings, 8.0, 0.0, "first", None).model_copy(update=one_speed)
            await place.put_back()  # nothing yet: the arm stands there with open fingers
            state = await upright(plan, partial(insertion, cell), place, print)
            back = [pose.position_mm for _, _, pose in cell.trace[refused_at[0] :]]
            return state, armed, speeds, part.held, back, [fastest_mm_s(cell.trace[begin:]) for begin in descents]

    state, armed, speeds, held, back, measured = run(work)
    assert state.phase is Phase.INSERTED
    assert state.attempt == len(armed) - 1, "an attempt that was not armed is none"
    assert [name == "first" for name, _, _ in armed[:3]] == [True, True, False]
    assert armed[2][1] == 1
    assert armed[2][2] == pytest.approx(armed[1][2], abs=0.2)
    assert speeds[1] < speeds[0]
    assert measured == pytest.approx(speeds, rel=0.2), "as fast as told, for which the lease is made"
    assert held
    (x, y, _), *way = back
    aside = next(at for at in way if math.hypot(at[0] - x, at[1] - y) > 0.2)
    assert aside[2] > PICK.z_mm + RETREAT_MM - 0.2, "first straight up, from between its neighbours, then over"


@pytest.mark.slow
def test_an_object_that_comes_along_with_the_fingers_is_noticed():
    async def work():
        async with cell_with() as (cell, part):
            running = cycle_of(cell)

            part.released = lambda: setattr(part, "sticky", True)
            with pytest.raises(CycleHeldError, match="came along with the fingers"):
                await running.run(3)
            return running.count.inserted_n

    assert run(work) == 0


@pytest.mark.slow
def test_what_cannot_be_inserted_is_carried_to_the_reject_pose_and_too_many_hold():
    async def work():
        async with cell_with(limits={"max_attempts": 1}) as (cell, part):
            cell.service.share = 0.0
            running = cycle_of(cell, reject=REJECT, max_rejects_in_a_row=1)
            with pytest.raises(CycleHeldError, match="2 in a row"):
                await running.run(3)
            return running.count, part.left, part.held

    count, left, held = run(work)
    assert (count.inserted_n, count.rejected_n) == (0, 1)
    ((_, _, at),) = left
    assert at[0] == pytest.approx(REJECT.x_mm, abs=1.0)
    assert at[2] == pytest.approx(REJECT.z_mm, abs=1.0)
    assert held, "the second one stays in the hand"


def test_a_fault_during_an_insertion_holds_the_object():
    async def work():
        async with cell_with() as (cell, part):

            def fault(message):
                if isinstance(message, wire.Descending):
                    cell.board.update({"robot": {"protective_stop": True}})

            cell.service.on_message = fault
            with pytest.raises(CycleHeldError, match="part 1: "):
                await cycle_of(cell, reject=REJECT).run(1)
            return part.held, part.left

    held, left = run(work)
    assert held
    assert left == []


def test_it_does_not_begin_with_something_in_the_hand():
    async def work():
        async with bench(holding=True) as cell:
            with pytest.raises(CycleHeldError, match="holds something before the first part"):
                await cycle_of(cell).run(1)
            return cell.gripper.holding

    assert run(work)


@pytest.mark.slow
def test_a_person_pauses_goes_on_and_stops_after_a_part():
    async def work():
        async with cell_with() as (cell, _):
            lines = []
            running = cycle_of(cell, lines)
            running.pace.order("pause")
            task = asyncio.create_task(running.run(None))
            await until(lambda: "paused" in lines)
            assert running.count.inserted_n == 0
            running.pace.order("resume")
            await until(lambda: "part 1: picking" in lines)
            running.pace.order("stop")
            return (await task).inserted_n

    assert run(work) == 1
    assert Pace().order("dance").startswith("expected pause")


@pytest.mark.slow
def test_a_plc_starts_each_part_and_is_told_when_it_is_done():
    async def work():
        async with cell_with() as (cell, _):
            signals, written = cell.cabinet.signals, []

            async def plc():
                for _ in range(2):
                    for name, value in (("doTactileReady", 1.0), ("doTactileDone", 1.0)):
                        await until(lambda name=name, value=value: signals[name] == value)
                        written.append(name)
                        signals["diTactileStart"] = 1.0 if name == "doTactileReady" else 0.0

            task = asyncio.create_task(plc())
            count = await cycle_of(cell, plc=HandshakeSettings()).run(2)
            await task
            return count.inserted_n, written, dict(signals)

    inserted_n, written, signals = run(work)
    assert inserted_n == 2
    assert written == ["doTactileReady", "doTactileDone"] * 2
    assert [signals[name] for name in SIGNALS] == [0.0, 0.0, 0.0, 0.0]


def test_a_paused_cycle_is_not_ready_for_a_plc():
    async def work():
        async with cell_with() as (cell, _):
            signals, lines, levels = cell.cabinet.signals, [], []
            running = cycle_of(cell, lines, plc=HandshakeSettings())
            task = asyncio.create_task(running.run(None))
            for word, line in (("", "waiting for the PLC"), ("pause", "paused"), ("resume", "waiting for the PLC")):
                running.pace.order(word)
                lines.clear()
                await until(lambda line=line: line in lines and signals["doTactileReady"] != (line == "paused"))
                levels.append(signals["doTactileReady"])
            running.pace.order("stop")
            return (await task).inserted_n, levels

    assert run(work) == (0, [1.0, 0.0, 1.0])


def test_a_plc_that_starts_before_anybody_is_ready_is_a_fault():
    async def work():
        async with cell_with() as (cell, _):
            cell.cabinet.signals["diTactileStart"] = 1.0
            with pytest.raises(DriverError, match="diTactileStart is on before"):
                await cycle_of(cell, plc=HandshakeSettings()).run(1)
            return cell.cabinet.signals["doTactileFault"]

    assert run(work) == 1.0


@pytest.mark.slow
@pytest.mark.timeout(2400)
def test_fifty_parts_in_a_row_with_faults_let_nothing_go_where_it_is_not_in():
    """Every seventh insertion meets a fault; a person clears it, puts the part away, and starts the cycle again.

    Every third part that an attempt has blocked is refused as turned in the hand, and every fifth of these meets a
    protective stop on its way back to the fixture.
    """
    faults = [
        {"robot": {"protective_stop": True}},
        {"gripper": {"part_lost": True}},
        {"egm": {"silent": True}},
        {"gripper": {"fast_stop": True}},
        {"robot": {"motors_off": True}},
    ]

    async def work():
        async with cell_with(seed=3) as (cell, part):
            count, lines = Counter(), []

            def trouble(message):
                if isinstance(message, wire.Descending) and message.attempt == 1:
                    count["descents"] += 1
                    if count["descents"] % 7 == 0:
                        cell.board.update(faults[count["descents"] // 7 % len(faults)])
                if isinstance(message, wire.Arm) and message.attempt == 2:
                    count["blocked"] += 1
                    if count["blocked"] % 3 == 0:
                        count["turned"] += 1
                        if count["turned"] % 5 == 0:
                            cell.board.update(faults[0])
                        return [turned(message)]
                count["told"] += isinstance(message, wire.Abort) and message.cause == "afresh"
                return None

            cell.service.on_message = trouble
            while count["inserted"] < 50:
                running = cycle_of(cell, lines)
                try:
                    await running.run(50 - count["inserted"])
                except DriverError:
                    count["held"] += 1
                    cell.board.clear()
                    cell.gripper.holding, part.held, part.is_put_back = False, False, False
                    cell.gripper.stop()
                    cell.gripper.acknowledge()
                count["inserted"] += running.count.inserted_n
            count["afresh"] = sum(line.startswith("back to the fixture") for line in lines)
            return count, [one for one in part.left if one[2][2] < 30.0]

    count, left_low = run(work, 2300.0)
    print(count)
    assert count["inserted"] == 50
    assert count["held"] >= 7
    assert count["afresh"] == count["told"] == count["turned"] >= 10
    assert sum(is_in(one) for one in left_low) >= 50
    assert [one for one in left_low if not is_in(one) and one[2][2] < 20.0] == []
