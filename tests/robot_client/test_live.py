"""The whole client against emulated devices over real sockets: it inserts, and it stops in time."""

import asyncio
import itertools
import json

import pytest

from robot_client.insertion.state import Phase
from robot_client.session.replay import replay
from service.contract import wire
from tests.robot_client.live_cell import bench


def run(coroutine):
    return asyncio.run(asyncio.wait_for(coroutine, 60.0))


async def _insert(tmp_path=None, lag_ms=20.0, **options):
    log = tmp_path / "episode.jsonl" if tmp_path else None
    async with bench(lag_ms=lag_ms, **options) as cell:
        state = await cell.insert(log=log)
        cell.farewell = cell.runner.farewell
        return cell, state


@pytest.fixture(scope="module", params=[20.0, pytest.param(50.0, marks=pytest.mark.slow)], ids="lag {:g} ms".format)
def inserted(request, tmp_path_factory):
    """One insertion by the real protocols, for each lag of the arm: the cell after it, the final state, its log."""
    folder = tmp_path_factory.mktemp("episode")
    cell, state = run(_insert(folder, lag_ms=request.param, holding=False))
    assert state.phase is Phase.INSERTED, state.reason
    return cell, state, folder / "episode.jsonl", request.param


def test_it_inserts_over_the_real_protocols_and_leaves_the_controller_stopped(inserted):
    cell, state, _, _ = inserted
    assert state.attempt == 2
    x, _, z = cell.cabinet.arm.pose.position_mm
    assert abs(x) < 2.5
    assert z == pytest.approx(23.0, abs=0.1)
    assert cell.farewell.startswith("controller confirms")
    assert cell.cabinet.running is False


def test_the_log_holds_the_attempts_and_replays(inserted):
    _, state, log, _ = inserted
    assert replay(log, show=lambda _line: None) == state
    end = json.loads(log.read_text().splitlines()[-1])["end"]
    assert end["inserted"]
    assert [row["attempt"] for row in end["rows"]] == [1, 2]


def _lowered(cell):
    """When, in s, the controller took a target lower than the one before."""
    return [t1 for (_, a, _), (t1, b, _) in itertools.pairwise(cell.trace) if b.position_mm[2] < a.position_mm[2]]


def test_slip_freezes_the_target_at_once_and_overtravel_is_lag_times_speed(inserted):
    """Counted in cycles of 4 ms, whatever the machine: what was on its way when the slip message came, and no more."""
    cell, _, log, lag_ms = inserted
    events = [json.loads(line).get("event", {}) for line in log.read_text().splitlines()]
    received_s = next(event["at_s"] for event in events if event.get("message", {}).get("type") == "slip")
    stood_s = next(event["at_s"] for event in events if event.get("kind") == "standstill")
    assert sum(received_s < now < stood_s for now in _lowered(cell)) <= 2
    assert cell.report.rows[0].overtravel_mm < lag_ms * 0.01 + 0.35


@pytest.mark.slow
def test_slip_freezes_the_target_on_the_wire_within_a_frame(inserted):
    cell, _, _, lag_ms = inserted
    (slip_ns,) = cell.service.slips_ns
    late_ms = (max(now for now in _lowered(cell) if abs(now - slip_ns / 1e9) < 0.5) - slip_ns / 1e9) * 1e3
    print(f"lag {lag_ms:g} ms: last lowered target {late_ms:.1f} ms after the slip message")
    assert late_ms < 33.3


def test_the_arm_never_leaves_the_vertical_lower_than_three_mm_above_the_tops(inserted):
    low = [(now, pose) for now, _, pose in inserted[0].trace if pose.position_mm[2] < 32.9]
    assert len(low) > 100
    for (t0, a), (t1, b) in itertools.pairwise(low):
        if t1 - t0 < 0.05:
            assert abs(b.position_mm[0] - a.position_mm[0]) < 1e-3
            assert abs(b.yaw_deg - a.yaw_deg) < 1e-3


def test_the_gripper_is_asked_to_grasp_what_it_does_not_hold_and_is_never_stopped(inserted):
    cell, *_ = inserted
    assert "GRASP" in cell.wsg.counters.commands
    assert not {"STOP", "FAST_STOP", "ACKNOWLEDGE", "HOMING"} & set(cell.wsg.counters.commands)
    assert cell.wsg.counters.fast_stops_by_disconnect == 0


def test_a_repeated_correction_moves_the_arm_once():
    async def story():
        async with bench() as cell:

            def twice(message):
                if isinstance(message, wire.Stopped) and message.outcome == "blocked":
                    return [cell.service.correction(message.attempt)] * 3
                return None

            cell.service.on_message = twice
            state = await cell.insert()
            return state, cell.report.rows

    state, rows = run(story())
    assert state.phase is Phase.INSERTED, state.reason
    assert rows[1].x_mm == pytest.approx(8.0 * 0.3, abs=0.05)


def test_an_interrupt_holds_the_arm_and_stops_the_program():
    async def story():
        async with bench() as cell:
            task = asyncio.create_task(cell.insert())
            for _ in range(2000):
                await asyncio.sleep(0.01)
                if cell.service.received and cell.service.received[-1].type == "descending":
                    break
            await asyncio.sleep(0.3)
            task.cancel()
            return cell, await task

    cell, state = run(story())
    assert state.phase is Phase.FAILED
    assert "operator" in state.reason
    assert cell.cabinet.arm.at_rest
    assert not cell.cabinet.running
