"""Telemetry never delays a stop; its contents are tested in test_live.py."""

import pytest

from robot_client.cli.insert import make_plan
from robot_client.robots.dry_run.driver import DryArm
from robot_client.session import service_link
from robot_client.session.service_link import ServiceLink, ServiceSettings
from robot_client.session.telemetry import BATCH_N, Telemetry
from robot_client.settings import load_settings
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


@pytest.mark.parametrize("simulated", [True, False])
def test_a_recording_is_told_whether_its_cell_is_simulated(simulated: bool) -> None:
    settings, sent = load_settings(None, {}), []
    plan = make_plan(settings, 0.0, 0.0, ID, None)
    Telemetry(plan, DryArm(settings.limits, settings.ramps), sent.append, simulated).begin(plan.approach)
    assert sent[0].simulated is simulated
