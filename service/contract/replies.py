"""Answers that need no session: clocks, heartbeats, and to a client of another protocol; and how an insertion ended."""

from collections.abc import Sized
from typing import Any, Literal

from pydantic import BaseModel, ValidationError

from service.contract.wire import (
    MAX_TEXT_BYTES,
    PROTOCOL,
    Cause,
    ClientHeartbeat,
    ClientHello,
    Clock,
    Ending,
    Fault,
    InsertionId,
    ServiceHeartbeat,
)

MEANT: dict[str, Ending] = {"operator": "aborted", "probed": "probed", "afresh": "regrasped"}
"""Outcomes by cause of what ended as it was meant to: they count neither as inserted nor as failed."""


class Greeting(BaseModel):
    """What a `hello` of any protocol holds; its other fields need not be ours, nor its role one of ours."""

    type: Literal["hello"]
    insertion_id: InsertionId
    protocol: int
    role: Any = "drive"


def greeting_of(text: str) -> Greeting | None:
    """A client's first message as a `hello` of any protocol; None for anything else."""
    try:
        return Greeting.model_validate_json(text[:MAX_TEXT_BYTES])
    except ValidationError:
        return None


def unspoken(hello: ClientHello | Greeting) -> Fault | None:
    """Why a client of another protocol cannot be served, None if it speaks ours."""
    if hello.protocol == PROTOCOL:
        return None
    detail = f"client speaks protocol {hello.protocol}, this service {PROTOCOL}; update the older one"
    return Fault(insertion_id=hello.insertion_id, code="protocol_version", detail=detail, fatal=True)


def clock(message: ClientHello | ClientHeartbeat, now_ns: int) -> Clock | None:
    """The answer to a client's clock at ``now_ns`` of the service's clock; None if the client did not ask."""
    return None if message.sent_ns is None else Clock(sent_ns=message.sent_ns, service_ns=now_ns)


def beat(message: ClientHeartbeat, now_ns: int, frame_age_ms: float | None) -> ServiceHeartbeat:
    """The answer to a client's heartbeat at ``now_ns`` of the service's clock."""
    named, count = message.insertion_id, message.count
    return ServiceHeartbeat(insertion_id=named, count=count, clock=clock(message, now_ns), frame_age_ms=frame_age_ms)


def ending(cause: Cause | None) -> Ending:
    """The outcome of an insertion from its cause: inserted if there are no objections."""
    if cause is None:
        return "inserted"
    return "not_confirmed" if cause == "not_confirmed" else MEANT.get(cause, "failed")


def descended_n(cause: str | None, attempts_n: int, doubts: Sized) -> int:
    """The attempts that went down: the last did not if its refusal ended the insertion, which states no doubts."""
    return max(0, attempts_n - (cause in {"afresh", "refused"} and not doubts))
