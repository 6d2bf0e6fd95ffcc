"""The whole client against emulated devices over real sockets: it inserts, and it stops in time."""

import asyncio
import itertools
import json
import time

import pytest

from robot_client.insertion.state import Phase
from robot_client.session.replay import replay
from robot_client.session.telemetry import BATCH_N
from service import __version__
from service.contract import wire
from tests.robot_client.live_cell import bench, undisturbed


async def _insert(log, **options):
    async with bench(**options) as cell:
        cell.heard = []

        def listen(message):
            if isinstance(message, wire.Episode | wire.Telemetry):
                cell.heard.append((time.monotonic_ns(), message))
            if isinstance(message, wire.Stopped) and message.outcome == "blocked":
                return [cell.service.correction(message.attempt)] * 3
            return None

        cell.service.on_message = listen
        state = await cell.insert(log=log)
        cell.farewell = cell.runner.farewell
        return cell, state


@pytest.fixture(scope="module", params=[20.0, pytest.param(50.0, marks=pytest.mark.slow)], ids="lag {:g} ms".format)
def inserted(request, tmp_path_factory):
    """One insertion by the real protocols, for each lag of the arm: the cell after it, the final state, its log.

    The service repeats each correction twice.
    """

    async def story():
        log = tmp_path_factory.mktemp("episode") / "episode.jsonl"
        cell, state = await _insert(log, lag_ms=request.param, holding=False)
        assert state.phase is Phase.INSERTED, state.reason
        return cell, state, log, request.param

    return undisturbed(story)


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


def test_a_repeated_correction_moves_the_arm_once(inserted):
    assert inserted[0].report.rows[1].x_mm == pytest.approx(8.0 * 0.3, abs=0.05)


def test_an_insertion_tells_what_was_to_be_done_and_where_the_robot_was(inserted):
    cell, *_ = inserted
    (_, episode), *batches = cell.heard
    lowest_mm = min(pose.position_mm[2] for _, _, pose in cell.trace)
    assert isinstance(episode, wire.Episode)
    assert episode.versions["client"] == __version__
    assert (episode.approach.x_mm, episode.approach.yaw_deg) == (8.0, 6.0)
    assert episode.start.z_mm == pytest.approx(40.0, abs=0.5)
    samples = [sample for _, batch in batches for sample in batch.samples]
    stamps = [sample.at_ns for sample in samples]
    assert stamps == sorted(stamps)
    assert {sample.width_mm for sample in samples[-5:]} == {50.0}
    deepest = max(sample.depth_mm for sample in samples if sample.depth_mm is not None)
    assert deepest == pytest.approx(episode.approach.z_mm - lowest_mm, abs=1.0)
    assert {sample.phase for sample in samples} >= {"approaching", "descending"}
    moving = [sample for sample in samples if sample.phase == "descending"]
    assert all(s.commanded.z_mm <= s.measured.z_mm + 0.5 for s in moving)  # the arm lags behind what it is told
    assert any(s.commanded.z_mm < s.measured.z_mm - 0.05 for s in moving)
    assert samples[-1].at_ns > cell.heard[-1][0] - int(0.5e9)


def test_nothing_waits_longer_than_a_batch_to_be_sent(inserted):
    """A killed client thus loses a tenth of a second, as far as its machine had the time."""
    _, *batches = inserted[0].heard
    assert all(len(batch.samples) <= BATCH_N for _, batch in batches)
    spans = sorted((batch.samples[-1].at_ns - batch.samples[0].at_ns) * 1e-9 for _, batch in batches)
    assert spans[len(spans) // 2] == pytest.approx(0.02 * (BATCH_N - 1), rel=0.25)


def test_an_interrupt_holds_the_arm_and_stops_the_program():
    async def story():
        async with bench() as cell:
            state = await _interrupted(cell)
            assert state.phase is Phase.FAILED
            assert "operator" in state.reason
            assert cell.cabinet.arm.at_rest
            assert not cell.cabinet.running

    undisturbed(story)


def test_a_part_left_in_the_fingers_of_a_gripper_that_forgot_it_teaches_no_open_gel():
    """A WSG-50 that is left reports no part any more, though its fingers are still on it."""

    async def story():
        async with bench(holding=False) as cell:
            await _interrupted(cell)
            cell.service.received.clear()
            await cell.insert()
            kinds = [message for message in cell.service.received if message.type in {"learn_open", "arm"}]
            assert [getattr(message, "forget", None) for message in kinds[:3]] == [False, True, None]

    undisturbed(story)


async def _interrupted(cell):
    """An insertion that a person breaks off in its descent."""
    task = asyncio.create_task(cell.insert())
    for _ in range(2000):
        await asyncio.sleep(0.01)
        if cell.service.received and cell.service.received[-1].type == "descending":
            break
    await asyncio.sleep(0.3)
    task.cancel()
    return await task
