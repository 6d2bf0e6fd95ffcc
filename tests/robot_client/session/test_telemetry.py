"""What the robot did reaches the service fifty times a second, and never keeps a stop waiting."""

import asyncio
import time

import pytest

from robot_client.session import service_link
from robot_client.session.service_link import ServiceLink, ServiceSettings
from robot_client.session.telemetry import BATCH_N
from service.contract import wire
from tests.robot_client.insertion.stories import ID
from tests.robot_client.live_cell import bench


@pytest.fixture(scope="module")
def told():
    """What an insertion at the emulated cell tells the service, and how low the arm went; a busy machine may end it."""

    async def story():
        heard = []
        async with bench() as cell:

            def listen(message):
                if isinstance(message, wire.Episode | wire.Telemetry):
                    heard.append((time.monotonic_ns(), message))

            cell.service.on_message = listen
            await cell.insert()
            return heard, min(pose.position_mm[2] for _, _, pose in cell.trace)

    return asyncio.run(asyncio.wait_for(story(), 90.0))


def test_an_insertion_tells_what_was_to_be_done_and_where_the_robot_was(told) -> None:
    heard, lowest_mm = told
    (_, episode), *batches = heard
    assert isinstance(episode, wire.Episode)
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
    assert samples[-1].at_ns > [at for at, _ in heard][-1] - int(0.5e9)


def test_nothing_waits_longer_than_a_batch_to_be_sent(told) -> None:
    """So a client that is killed takes a tenth of a second with it, as far as its machine had the time."""
    _, *heard = told[0]
    assert all(len(batch.samples) <= BATCH_N for _, batch in heard)
    spans = sorted((batch.samples[-1].at_ns - batch.samples[0].at_ns) * 1e-9 for _, batch in heard)
    assert spans[len(spans) // 2] == pytest.approx(0.02 * (BATCH_N - 1), rel=0.25)


def test_a_slow_connection_loses_samples_and_counts_them_and_a_stop_goes_first_come_first_served() -> None:
    async def story() -> None:
        link = ServiceLink(ServiceSettings(), ID)  # nothing takes messages out of its queue
        sample = wire.RobotSample(at_ns=1, phase="descending", attempt=1)
        batch = wire.Telemetry(insertion_id=ID, sent_ns=1, samples=(sample,) * BATCH_N)
        for _ in range(1000):
            link.send(batch)
        assert link._outbox.qsize() == service_link.MOST_WAITING
        link.send(wire.Abort(insertion_id=ID, cause="operator", reason="stop"))
        waiting = [link._outbox.get_nowait() for _ in range(link._outbox.qsize())]
        assert waiting[-1].type == "abort"
        link.send(batch)
        assert link._outbox.get_nowait().left_out_n == BATCH_N * (1000 - service_link.MOST_WAITING)
        link.send(batch)
        assert link._outbox.get_nowait().left_out_n == 0

    asyncio.run(story())
