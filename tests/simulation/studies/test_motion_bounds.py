"""Live insertions with injected faults: the measurements, and that the bounds hold."""

import json
import shutil
import socket
import socketserver
import threading
import time

import pytest

from simulation.cell.run import RunOptions
from simulation.studies.motion_bounds import campaign
from simulation.studies.motion_bounds.campaign import cases
from simulation.studies.motion_bounds.faults import FAULTS, Fault
from simulation.studies.motion_bounds.play import _entries, _moved_mm, _travel_mm, row_of
from simulation.studies.motion_bounds.relay import DRIP_S, Relay
from simulation.studies.motion_bounds.report import bounds_page

MS = 1_000_000


def test_there_are_at_least_sixty_faults_and_phases():
    named = [(fault.name, phase) for fault, phase in cases()]
    assert len(named) == len(set(named)) >= 60


def test_a_campaign_that_was_killed_while_it_wrote_a_row_goes_on(tmp_path, monkeypatch):
    def row_of(fault, phase, _options, _folder):
        return {"fault": fault.name, "phase": phase, "travel_mm": 1.0, "force_n": 2.0, "ended": "killed"}

    monkeypatch.setattr(campaign, "row_of", row_of)
    options = campaign.BoundsOptions(runs=tmp_path, only="link reset")
    (tmp_path / "rows.jsonl").write_text('{"fault": "link re')
    first = campaign.measure(options, lambda _: None)
    assert [(row["fault"], row["phase"]) for row in first] == [("link reset", "air"), ("link reset", "contact")]
    monkeypatch.setattr(campaign, "row_of", lambda *_: pytest.fail("measured again"))
    assert campaign.measure(options, lambda _: None) == first
    monkeypatch.setattr(campaign, "_code_sha256", str)
    with pytest.raises(ValueError, match="holds results of other robot_client, service, simulation; expected an empty"):
        campaign.measure(options, lambda _: None)


def story(frames_ms, *, held_ms):
    """An episode: a descent at 0 ms, frames judged at these times, a hold, and one more frame heard after it."""
    heard = [
        {"event": {"at_s": ms / 1e3, "message": {"type": "watching", "frame_captured_ns": ms * MS}}} for ms in frames_ms
    ]
    late = {"event": {"at_s": held_ms / 1e3, "message": {"type": "watching", "frame_captured_ns": (held_ms - 1) * MS}}}
    descend = {"command": {"kind": "move", "motion": "descend"}}
    return [descend, *heard, {"event": {"at_s": held_ms / 1e3}}, {"command": {"kind": "hold"}}, late]


TRACE = [(ms * MS, 40.0 - 0.01 * min(ms, 230)) for ms in range(1000)]  # 10 mm/s until 230 ms, then at rest


@pytest.mark.parametrize(
    ("fault", "begun_ms", "travel_mm"),
    [
        (Fault("plain", lambda _: None), 120, 1.3),
        (Fault("late", lambda _: None, hides_s=0.05), 60, 1.7),
        (Fault("frozen", lambda _: None, hides_s=float("inf")), 60, 1.7),
    ],
)
def test_the_way_counts_from_the_last_picture_that_showed_the_world(fault, begun_ms, travel_mm):
    entries = story([33, 66, 100], held_ms=210)
    assert _travel_mm(TRACE, entries, fault, begun_ms * MS) == pytest.approx(travel_mm, abs=0.02)


def test_motion_after_the_hold_is_seen():
    entries = story([33], held_ms=210)
    creeping = [(ms * MS, 40.0 - 0.001 * ms) for ms in range(2000)]
    assert _moved_mm(TRACE, entries) == pytest.approx(0.0, abs=1e-9)
    assert _moved_mm(creeping, entries) > 1.0


def test_a_regrasp_is_part_of_the_insertion_and_its_way_no_motion_after_the_hold(tmp_path):
    for name, entry in (("20261201-061440-2", "again"), ("episode", "first"), ("20261201-061450-1", "last")):
        (tmp_path / f"{name}.jsonl").write_text(json.dumps({"name": entry}) + "\n")
    assert [entry["name"] for entry in _entries(tmp_path)] == ["first", "again", "last"]


class Echo(socketserver.BaseRequestHandler):
    """An echo server."""

    def handle(self):
        while data := self.request.recv(100):
            self.request.sendall(data)


@pytest.fixture
def echo():
    """A relay to a server that echoes."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Echo) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        relay = Relay.to(f"http://127.0.0.1:{server.server_address[1]}")
        yield relay
        relay.close()
        server.shutdown()


def sent_through(relay, text=b"0123456789", timeout_s=1.0):
    with socket.create_connection(("127.0.0.1", relay.own_port), 5.0) as link:
        link.sendall(text)
        link.settimeout(timeout_s)
        heard, begun = b"", time.monotonic()
        try:
            while len(heard) < len(text) and (more := link.recv(100)):
                heard += more
        except OSError:
            pass
        return heard, time.monotonic() - begun


def test_a_bad_network_is_as_bad_as_it_says(echo):
    assert sent_through(echo)[0] == b"0123456789"
    echo.misbehave("drip")
    assert sent_through(echo, timeout_s=5.0)[1] >= 8 * DRIP_S
    echo.misbehave("late", 0.1)
    heard, took_s = sent_through(echo, timeout_s=5.0)
    assert (heard, took_s >= 0.2) == (b"0123456789", True)
    echo.misbehave("half open")
    assert sent_through(echo)[0] == b""


def test_the_page_names_the_worst_fault_first():
    row = {"fault": "f", "phase": "air", "injected": True, "travel_mm": 1.1, "force_n": 9.0, "moved_mm": 0.0}
    row |= {"ended": "arm: unwatched", "inserted": False, "hung": False, "tracebacks": 0, "held": True}
    text = bounds_page({"rows": [row, row | {"fault": "g", "travel_mm": 9.0, "force_n": 19.0}]})
    assert "The worst of 2 faults is *g, air*: the arm travelled 9.00 mm" in " ".join(text.split())
    assert "The largest force was 19.0 N" in text
    assert text.index("| f | air | 1.10 |") < text.index("| g | air | 9.00 |")


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("name", "phase"), [(fault.name, phase) for fault, phase in cases()])
def test_every_bound_holds_live(name, phase, tmp_path):
    fault = next(fault for fault in FAULTS if fault.name == name)
    if fault.sets_clock and shutil.which("cc") is None:
        pytest.skip("no C compiler on this machine")
    row = row_of(fault, phase, RunOptions(), tmp_path)
    assert row["injected"], row
    assert row["held"], row
