"""The insertion WebSocket, message by message. One connection is one insertion.

Text frames are JSON objects with a ``type``; binary frames are :func:`service.contract.frames.encode_frame`.
Every message carries the insertion id and, where it concerns one, the attempt number (1-based). Positions are
millimetres and degrees in the work-object frame. Stamps (``_ns``) are the service's monotonic clock; only ``sent_ns``
is the client's, which the service sends back beside its own clock (:class:`Clock`).

client:  hello -> episode? -> learn_open? -> (arm -> descending -> stopped)*
         abort, heartbeat and telemetry at any time
service: hello -> open_learnt? -> (armed -> watching* -> (slip | enough)? -> correction | no_decision)* -> finished
         refused instead of armed; fault and heartbeat at any time
"""

from typing import Annotated, Literal, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from service.contract.frames import ContractError, Finger, first_error
from service.contract.wire_parts import (
    MAX_ATTEMPTS,
    PRESS_MM,
    Attempt,
    CameraEntry,
    Cause,
    Clock,
    ControllerName,
    Doubt,
    DoubtReason,
    Ending,
    Enough,
    Episode,
    Estimate,
    FaultCode,
    InsertionId,
    Limits,
    ModelEntry,
    NoDecisionReason,
    Outcome,
    RefusalReason,
    Refused,
    RobotSample,
    Telemetry,
    ToolPose,
)
from service.contract.wire_parts import InsertionMessage as _Message

__all__ = [
    "MAX_ATTEMPTS",
    "PRESS_MM",
    "Attempt",
    "CameraEntry",
    "Cause",
    "Clock",
    "ControllerName",
    "Doubt",
    "DoubtReason",
    "Ending",
    "Enough",
    "Episode",
    "Estimate",
    "FaultCode",
    "InsertionId",
    "Limits",
    "ModelEntry",
    "NoDecisionReason",
    "Outcome",
    "RefusalReason",
    "Refused",
    "RobotSample",
    "Telemetry",
    "ToolPose",
]  # the parts; what is defined here goes without saying
PROTOCOL = 2
MAX_TEXT_BYTES = 65536


class ClientHello(_Message):
    """First message. ``role`` watch receives everything and sends heartbeats alone. ``continues``: see `Refused`.

    ``takes_afresh``: the client can put an object that has turned in the hand back and take it upright.
    """

    type: Literal["hello"] = "hello"
    protocol: int = PROTOCOL
    client: str = Field(max_length=128)
    sent_ns: int | None = None
    role: Literal["drive", "watch"] = "drive"
    controller: ControllerName | None = None
    continues: InsertionId | None = None
    takes_afresh: bool = False


class LearnOpen(_Message):
    """The hand is open and nothing touches the gels: learn what they look like. Sent before each grasp."""

    type: Literal["learn_open"] = "learn_open"


class Arm(_Message):
    """The arm stands above the gap, holding the object still: take the reference, watch for slip.

    ``grasp_height_mm`` is the height of the TCP above the blocks' top faces when the object touches them, the lever arm
    of the edge's friction; None if nobody knows it. ``gripper_width_mm``: how far apart the fingers are; None if the
    gripper does not tell. ``grip_n`` is their force, ``shear_reach_mm`` how far the gel shears before it slides.
    ``press_mm``: how far to press after the touch. ``until_slip``: press on until the gel slides, to learn about it.
    """

    type: Literal["arm"] = "arm"
    attempt: Attempt
    gap_width_mm: float = Field(gt=0, le=1000)
    grasp_height_mm: float | None = Field(default=None, gt=0, le=500)
    grip_n: float | None = Field(default=None, gt=0, le=1000)
    shear_reach_mm: float | None = Field(default=None, gt=0, le=100)
    expected_depth_mm: float = Field(gt=0, le=1000)
    gripper_width_mm: float | None = Field(default=None, ge=0, le=1000)
    press_mm: float = Field(default=PRESS_MM, ge=0.6, le=3.0)
    until_slip: bool = False


class Descending(_Message):
    """A guarded descent begins, or goes on, at the speed told, from ``start_mm`` below the armed pose."""

    type: Literal["descending"] = "descending"
    attempt: Attempt
    speed_mm_s: float | None = Field(default=None, gt=0, le=1000)
    start_mm: float = Field(default=0.0, ge=0, le=1000)


class Stopped(_Message):
    """The arm stands still at ``depth_mm`` below the armed pose. ``inserted`` and ``dropped`` end the insertion.

    ``inserted``: full depth was reached; `finished` reports whether that is confirmed. ``gripper_width_mm``: now.
    ``still_s``: since when the arm stands, as far as the client knows.
    """

    type: Literal["stopped"] = "stopped"
    attempt: Attempt
    depth_mm: float
    outcome: Outcome
    gripper_width_mm: float | None = Field(default=None, ge=0, le=1000)
    still_s: float = Field(default=0.0, ge=0, le=1)


class Abort(_Message):
    """The client gives up; the recording is kept. ``cause`` is what is counted, ``reason`` is for a person."""

    type: Literal["abort"] = "abort"
    cause: Cause
    reason: str = Field(max_length=512)


class ClientHeartbeat(_Message):
    """Sent at least every second; the service answers with its own. It maps clocks and shows a link, nothing else."""

    type: Literal["heartbeat"] = "heartbeat"
    count: int = Field(ge=0)
    sent_ns: int | None = None


_Client = ClientHello | Episode | LearnOpen | Arm | Descending | Stopped | Abort | ClientHeartbeat | Telemetry
ClientMessage = Annotated[_Client, Field(discriminator="type")]


class ServiceHello(_Message):
    """Answer to the client's hello; the client checks it before it moves."""

    type: Literal["hello"] = "hello"
    protocol: int = PROTOCOL
    clock: Clock | None = None
    models: tuple[ModelEntry, ...]
    cameras: tuple[CameraEntry, ...]
    controller: ControllerName
    limits: Limits


class OpenLearnt(_Message):
    """Both open gels are learnt; the fingers may close."""

    type: Literal["open_learnt"] = "open_learnt"


class Armed(_Message):
    """Reference taken at this frame; the descent may begin. ``frame_captured_ns`` is the first one to move on."""

    type: Literal["armed"] = "armed"
    attempt: Attempt
    reference_seq: int
    frame_captured_ns: int


class Watching(_Message):
    """Both fingers were judged on new frames, and nothing speaks against going on: the arm may move a little longer.

    ``frame_captured_ns`` is the older finger's newest judged frame, ``judged_ns`` when this was sent. The client moves
    only while the newest of these is younger than its lease.
    """

    type: Literal["watching"] = "watching"
    attempt: Attempt
    frame_captured_ns: int
    judged_ns: int


class Slip(_Message):
    """Incipient slip: stop the arm now. ``age_ms`` is from capture of the frame to sending this."""

    type: Literal["slip"] = "slip"
    attempt: Attempt
    finger: Finger
    frame_seq: int
    captured_ns: int
    age_ms: float
    score: float
    reason: str


class Correction(_Message):
    """Retract, then move by (dx_mm, dtheta_deg) in the work-object frame. ``turns_deg``: as both fingers saw it."""

    type: Literal["correction"] = "correction"
    attempt: Attempt
    dx_mm: float
    dtheta_deg: float
    class_probabilities: dict[str, float]
    estimate: Estimate
    confidence: float = Field(ge=0, le=1)
    controller: ControllerName
    reason: str
    latency_ms: dict[str, float]
    turns_deg: tuple[float, float] | None = None


class NoDecision(_Message):
    """No correction can be trusted for this attempt; the client must not move on its own guess."""

    type: Literal["no_decision"] = "no_decision"
    attempt: Attempt
    reason: NoDecisionReason
    detail: str


class Finished(_Message):
    """The insertion is closed and its recording complete. No other outcome than ``inserted`` is an insertion.

    ``not_confirmed``: full depth was reached, and ``doubts`` says why that is not claimed to be an insertion. Where
    they are only that the object has turned, a client that regrasps it is told ``aborted``, cause ``afresh``.
    """

    type: Literal["finished"] = "finished"
    outcome: Ending
    attempts: int
    cause: Cause | None = None
    doubts: tuple[Doubt, ...] = ()
    recording: str | None = None


class Fault(_Message):
    """Something is wrong; hold the arm. ``fatal`` closes the connection."""

    type: Literal["fault"] = "fault"
    code: FaultCode
    detail: str
    fatal: bool = True


class ServiceHeartbeat(_Message):
    """Answer to a heartbeat, same count; for a person, the age of the newest frame of the finger further behind."""

    type: Literal["heartbeat"] = "heartbeat"
    count: int
    clock: Clock | None = None
    frame_age_ms: float | None


AttemptMessage = Armed | Refused | Watching | Slip | Enough | Correction | NoDecision
_Service = ServiceHello | OpenLearnt | AttemptMessage | Finished | Fault | ServiceHeartbeat
ServiceMessage = Annotated[_Service, Field(discriminator="type")]

_Parsed = TypeVar("_Parsed")
_CLIENT: TypeAdapter[ClientMessage] = TypeAdapter(ClientMessage)
_SERVICE: TypeAdapter[ServiceMessage] = TypeAdapter(ServiceMessage)


def _parse(adapter: TypeAdapter[_Parsed], text: str | bytes) -> _Parsed:
    if len(text) > MAX_TEXT_BYTES:
        raise ContractError(f"message of {len(text)} bytes, expected at most {MAX_TEXT_BYTES}")
    try:
        return adapter.validate_json(text)
    except ValidationError as error:
        raise ContractError(first_error(error, "message")) from error


def parse_client(text: str | bytes) -> ClientMessage:
    """Parse what a client sent; raise ContractError naming the field that is wrong."""
    return _parse(_CLIENT, text)


def parse_service(text: str | bytes) -> ServiceMessage:
    """Parse what the service sent; raise ContractError naming the field that is wrong."""
    return _parse(_SERVICE, text)
