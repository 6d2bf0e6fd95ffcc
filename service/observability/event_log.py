"""The log: one structured line for each event that matters to an operator, with the insertion's id."""

from typing import Any

import structlog

from service.contract import wire
from service.observability.hub import Hub

log = structlog.get_logger()


def log_events(hub: Hub) -> None:
    """Log the hub's events from now on. Frames and observations are counted in the metrics, not logged."""
    hub.subscribe(_on_event)


def _on_event(kind: str, content: Any) -> None:
    if kind == "message":
        line = facts(content)
        level = log.warning if content.type in {"fault", "no_decision"} else log.info
        level(content.type, **line)
    elif kind == "camera_fault":
        log.warning("camera", **content)
    elif kind == "error":
        log.error("error", detail=str(content))
    elif kind == "recorded":
        log.info("recorded", insertion=content.insertion_id, path=content.recording)


def facts(message: wire.ServiceMessage) -> dict[str, Any]:
    """The fields of a message that a log line carries."""
    line: dict[str, Any] = {"insertion": message.insertion_id}
    match message:
        case wire.Slip():
            line |= {"attempt": message.attempt, "finger": message.finger, "frame": message.frame_seq}
            line |= {"age_ms": round(message.age_ms, 1), "score": round(message.score, 3)}
        case wire.Correction():
            line |= {"attempt": message.attempt, "dx_mm": round(message.dx_mm, 3)}
            line |= {"dtheta_deg": round(message.dtheta_deg, 3), "confidence": round(message.confidence, 3)}
            line |= {"latency_ms": {stage: round(ms, 2) for stage, ms in message.latency_ms.items()}}
        case wire.NoDecision():
            line |= {"attempt": message.attempt, "reason": message.reason, "detail": message.detail}
        case wire.Armed():
            line |= {"attempt": message.attempt}
        case wire.Finished():
            line |= {"outcome": message.outcome, "attempts": message.attempts}
        case wire.Fault():
            line |= {"code": message.code, "detail": message.detail, "fatal": message.fatal}
        case _:
            pass
    return line
