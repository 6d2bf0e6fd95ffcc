import subprocess
import sys

import pytest

from service.contract import wire
from service.observability.hub import Hub
from service.observability.tracing import Spans, TracingError, make_tracer
from service.settings import read_settings

HELLO = {"models": (), "cameras": (), "controller": "belief"}
LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)
STAGES = {"rectify": 0.5, "markers": 2.0, "slip": 0.2, "networks_last_step": 2.5, "controller": 1.0}


def correction(attempt: int) -> wire.Correction:
    return wire.Correction(
        insertion_id="traced",
        attempt=attempt,
        dx_mm=1.0,
        dtheta_deg=0.0,
        class_probabilities={"near": 1.0},
        estimate=wire.Estimate(dx_mm=-1.0, dtheta_deg=0.0),
        confidence=0.9,
        controller="belief",
        reason="test",
        latency_ms=STAGES | {"since_last_frame": 40.0},
    )


def test_an_insertion_is_one_trace_with_a_span_an_attempt_and_a_stage() -> None:
    sdk = pytest.importorskip("opentelemetry.sdk.trace", reason="extra `otel` is not installed")
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    memory, provider, hub = InMemorySpanExporter(), sdk.TracerProvider(), Hub()
    provider.add_span_processor(SimpleSpanProcessor(memory))
    Spans(provider.get_tracer("test"), hub)
    hello = wire.ServiceHello(insertion_id="traced", limits=LIMITS, **HELLO)
    hub.publish("message", hello)
    hub.publish("message", wire.Armed(insertion_id="traced", attempt=1, reference_seq=4, frame_captured_ns=1))
    hub.publish("message", hello)  # the client lost its connection and came back
    hub.publish("message", correction(1))
    hub.publish("message", wire.Armed(insertion_id="traced", attempt=2, reference_seq=9, frame_captured_ns=2))
    hub.publish("message", wire.Finished(insertion_id="traced", outcome="inserted", attempts=2))
    spans = {f"{s.name}": s for s in memory.get_finished_spans()}
    names = [s.name for s in memory.get_finished_spans()]
    assert names == [*STAGES, "attempt", "attempt", "insertion"]
    root = spans["insertion"]
    assert len({s.context.trace_id for s in memory.get_finished_spans()}) == 1
    assert (root.parent, root.attributes["outcome"]) == (None, "inserted")
    for name, ms in STAGES.items():
        assert (spans[name].end_time - spans[name].start_time) / 1e6 == pytest.approx(ms, abs=0.01)
        assert spans[name].parent.span_id != root.context.span_id


def test_tracing_is_off_unless_asked_for() -> None:
    assert read_settings(["--camera-left", "push:", "--camera-right", "push:"]).tracing == "off"
    code = "import sys, service.cli.run; sys.exit('opentelemetry.sdk' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_tracing_without_its_libraries_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "opentelemetry.sdk.resources", None)
    with pytest.raises(TracingError, match=r"needs `pip install '\.\[otel\]'`"):
        make_tracer("otlp")


def test_the_console_exporter_prints_spans(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("opentelemetry.sdk.trace", reason="extra `otel` is not installed")
    from opentelemetry.sdk import trace

    tracer = make_tracer("console")
    assert isinstance(tracer, trace.Tracer)
