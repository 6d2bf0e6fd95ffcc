"""The log: one structured line for each event that matters to an operator, with the insertion's id."""

from typing import Any

import structlog

from service.contract import wire
from service.contract.replies import MEANT
from service.observability.hub import Hub

log = structlog.get_logger()
LOGGED = {
    "slip": ("attempt", "finger", "frame_seq", "age_ms", "score"),
    "enough": ("attempt", "frame_seq", "pressed_mm"),
    "correction": ("attempt", "dx_mm", "dtheta_deg", "confidence", "latency_ms"),
    "no_decision": ("attempt", "reason", "detail"),
    "armed": ("attempt",),
    "refused": ("attempt", "reason", "detail"),
    "straighten": ("attempt", "tilt_deg", "detail"),
    "abort": ("cause", "reason"),
    "finished": ("outcome", "attempts", "cause"),
    "fault": ("code", "detail", "fatal"),
}
SHORT = {"frame_seq": "frame"}


def log_events(hub: Hub) -> None:
    """Log the hub's events from now on. Frames and observations are counted in the metrics, not logged."""
    hub.subscribe(_on_event)


def _on_event(kind: str, content: Any) -> None:
    if kind == "message":
        line = facts(content)
        level = log.warning if content.type in {"fault", "no_decision", "refused"} else log.info
        level(content.type, **line)
    elif kind == "client" and isinstance(content, wire.Abort):
        level = log.info if content.cause in MEANT else log.warning
        level("abort", **facts(content))
    elif kind == "camera_fault":
        log.warning("camera", **content)
    elif kind in {"error", "unrecorded"}:
        log.error(kind, detail=str(content))
    elif kind in {"version", "drift"}:
        log.warning(kind, **content)
    elif kind == "recorded":
        log.info("recorded", insertion=content.insertion_id, path=content.recording)


def facts(message: wire.ServiceMessage | wire.Abort) -> dict[str, Any]:
    """The fields of a message for a log line, rounded; doubts as sentences."""
    line: dict[str, Any] = {"insertion": message.insertion_id}
    for name in LOGGED.get(message.type, ()):
        value = getattr(message, name)
        if isinstance(value, dict):
            value = {key: round(number, 2) for key, number in value.items()}
        line[SHORT.get(name, name)] = round(value, 3) if isinstance(value, float) else value
    if isinstance(message, wire.Finished) and message.doubts:
        line["doubts"] = "; ".join(doubt.detail for doubt in message.doubts)
    return line
