"""Telemetry never delays a stop; its contents are tested in test_live.py."""

from robot_client.session import service_link
from robot_client.session.service_link import ServiceLink, ServiceSettings
from robot_client.session.telemetry import BATCH_N
from service.contract import wire
from tests.robot_client.insertion.stories import ID


async def test_a_slow_connection_loses_samples_and_counts_them_and_a_stop_goes_first_come_first_served() -> None:
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
