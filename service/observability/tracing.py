"""OpenTelemetry, where it is installed (extra ``otel``) and asked for: a span an insertion, an attempt and a stage.

The spans are drawn afterwards from the messages and their measured latencies, so that tracing costs the decision
nothing. Stages are laid end to end before the moment of the answer.
"""

import time
from typing import Any

from service.contract import ContractError, wire
from service.observability.hub import Hub
from service.settings import Exporter

OVERLAPPING = {"since_last_frame"}  # this latency spans other stages: an attribute, not a span


class TracingError(ContractError):
    """Tracing was asked for but cannot be had."""


def make_tracer(exporter: Exporter) -> Any:
    """A tracer that exports as asked; raises TracingError if the libraries are missing.

    ``otlp`` goes to where the standard variables ``OTEL_EXPORTER_OTLP_*`` say (default: http://localhost:4318).
    """
    try:
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor, ConsoleSpanExporter, SpanExporter

        if exporter == "console":
            out: SpanExporter = ConsoleSpanExporter()
        else:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter

            out = OTLPSpanExporter()
    except ImportError as error:
        raise TracingError(f"--tracing {exporter} needs `pip install '.[otel]'` ({error})") from error
    provider = TracerProvider(resource=Resource.create({"service.name": "tactile-insertion"}))
    provider.add_span_processor(BatchSpanProcessor(out))
    return provider.get_tracer("tactile-insertion")


class Spans:
    """Draws the spans of one insertion after the other; called in the perception thread only."""

    def __init__(self, tracer: Any, hub: Hub) -> None:
        self._tracer = tracer
        self._insertion: Any = None
        self._id = ""
        self._attempt: Any = None
        hub.subscribe(self._on_event)

    def _on_event(self, kind: str, content: Any) -> None:
        if kind != "message":
            return
        now = time.time_ns()
        match content:
            case wire.ServiceHello() if content.insertion_id != self._id:
                self._end(now)
                self._id = content.insertion_id
                self._insertion = self._span("insertion", None, now, {"insertion.id": content.insertion_id})
            case wire.Armed():
                self._end_attempt(now)
                self._attempt = self._span("attempt", self._insertion, now, {"attempt": content.attempt})
            case wire.Slip() if self._attempt is not None:
                self._attempt.add_event("slip", {"finger": content.finger, "age_ms": content.age_ms}, now)
            case wire.Enough() if self._attempt is not None:
                self._attempt.add_event("enough", {"pressed_mm": content.pressed_mm}, now)
            case wire.Correction() if self._attempt is not None:
                self._stages(content, now)
            case wire.NoDecision() if self._attempt is not None:
                self._attempt.set_attribute("no_decision", content.reason)
                self._end_attempt(now)
            case wire.Finished():
                if self._insertion is not None:
                    self._insertion.set_attribute("outcome", content.outcome)
                self._end(now)

    def _stages(self, correction: wire.Correction, now: int) -> None:
        stages = {name: ms for name, ms in correction.latency_ms.items() if name not in OVERLAPPING}
        at = now - int(sum(stages.values()) * 1e6)
        for name, ms in stages.items():
            end = at + int(ms * 1e6)
            self._span(name, self._attempt, at, {}).end(end)
            at = end
        self._attempt.set_attribute("since_last_frame_ms", correction.latency_ms.get("since_last_frame", 0.0))
        self._attempt.set_attribute("confidence", correction.confidence)
        self._end_attempt(now)

    def _span(self, name: str, parent: Any, start_ns: int, attributes: dict[str, Any]) -> Any:
        from opentelemetry import context, trace

        # without a parent the span is a root, whatever else this process traces
        within = context.Context() if parent is None else trace.set_span_in_context(parent)
        return self._tracer.start_span(name, within, attributes=attributes, start_time=start_ns)

    def _end_attempt(self, now: int) -> None:
        if self._attempt is not None:
            self._attempt.end(now)
            self._attempt = None

    def _end(self, now: int) -> None:
        self._end_attempt(now)
        if self._insertion is not None:
            self._insertion.end(now)
            self._insertion = None
