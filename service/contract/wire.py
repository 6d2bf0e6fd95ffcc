"""The insertion WebSocket, message by message. One connection is one insertion.

Text frames are JSON objects with a ``type``; binary frames are :func:`service.contract.frames.encode_frame`.
Every message carries the insertion id and, where it concerns one, the attempt number (1-based). Positions are
millimetres and degrees in the work-object frame. Stamps (``_ns``) are the service's monotonic clock; only ``sent_ns``
and ``at_ns`` are the client's. The service sends ``sent_ns`` back beside its own clock (:class:`Clock`).

client:  hello -> episode? -> learn_open? -> (arm -> descending -> stopped)*
         abort, heartbeat and telemetry at any time
service: hello -> open_learnt? -> (armed -> watching* -> (slip | enough)? -> correction | no_decision)* -> finished
         straighten or refused instead of armed; fault and heartbeat at any time
"""

from typing import Annotated, Literal, TypeVar

from pydantic import Field, TypeAdapter, ValidationError

from service.contract.frames import ContractError, Finger, first_error
from service.contract.wire_parts import (
    MAX_ATTEMPTS,
    PRESS_MM,
    Armed,
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
    OpenLearnt,
    Outcome,
    RefusalReason,
    Refused,
    RobotSample,
    Straighten,
    Telemetry,
    ToolPose,
)
from service.contract.wire_parts import InsertionMessage as _Message

__all__ = [
    "MAX_ATTEMPTS",
    "PRESS_MM",
    "Armed",
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
    "OpenLearnt",
    "Outcome",
    "RefusalReason",
    "Refused",
    "RobotSample",
    "Straighten",
    "Telemetry",
    "ToolPose",
]  # the parts; what is defined here goes without saying
PROTOCOL = 2
MAX_TEXT_BYTES = 65536


class ClientHello(_Message):
    """First message. A client of ``role`` watch receives all but `Watching` and may send only heartbeats.

    ``continues``: the insertion whose object was regrasped, see `Refused`. ``takes_afresh``: the client can regrasp.
    ``most_tilt_deg``: how far it may be asked to `Straighten`, 0 with unchecked signs. ``purpose``: as of `Episode`.
    """

    type: Literal["hello"] = "hello"
    protocol: int = PROTOCOL
    client: str = Field(max_length=128)
    sent_ns: int | None = None
    role: Literal["drive", "watch"] = "drive"
    controller: ControllerName | None = None
    continues: InsertionId | None = None
    takes_afresh: bool = False
    most_tilt_deg: float = Field(default=0.0, ge=0, le=10)
    purpose: Literal["insert", "probe", "timing"] = "insert"


class LearnOpen(_Message):
    """The gripper is open and nothing touches the gels: learn their appearance. Sent before each grasp."""

    type: Literal["learn_open"] = "learn_open"
    forget: bool = False  # after the grasp: the fingers had been on the object all the time; no answer comes


class Arm(_Message):
    """The arm stands still above the gap and holds the object: take the reference and watch for slip.

    ``grasp_height_mm``: of the TCP above the blocks' tops at the touch. ``gripper_width_mm``: between the fingers.
    ``grip_n``: their force. ``shear_reach_mm``: how far the gel shears before it slides. ``press_mm``: how far to press
    after the touch, or ``until_slip``. ``tilt_deg``: of the tool, see `Straighten`. ``tops_level_mm``: largest step
    between the tops beside the gap; None with unchecked signs. ``neighbours_stay``: no press moves what stands there.
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
    tilt_deg: float = Field(default=0.0, ge=-10, le=10)
    tops_level_mm: float | None = Field(default=None, ge=0, le=10)
    neighbours_stay: bool = False


class Descending(_Message):
    """A guarded descent begins or goes on: at ``speed_mm_s`` from ``start_mm`` below `arm`, or after ``paused_s``."""

    type: Literal["descending"] = "descending"
    attempt: Attempt
    speed_mm_s: float | None = Field(default=None, gt=0, le=1000)
    start_mm: float = Field(default=0.0, ge=0, le=1000)
    paused_s: float = Field(default=0.0, ge=0, le=1)


class Stopped(_Message):
    """The arm stands still at ``depth_mm`` below the armed pose. ``inserted`` and ``dropped`` end the insertion.

    ``inserted``: full depth was reached; `finished` reports whether that is confirmed. ``gripper_width_mm`` is
    the present distance. ``still_s``: how long the arm has stood there, as far as the client knows.
    """

    type: Literal["stopped"] = "stopped"
    attempt: Attempt
    depth_mm: float
    outcome: Outcome
    gripper_width_mm: float | None = Field(default=None, ge=0, le=1000)
    still_s: float = Field(default=0.0, ge=0, le=1)


class Abort(_Message):
    """The client gives up; the recording is kept. Metrics count ``cause``; ``reason`` is for people."""

    type: Literal["abort"] = "abort"
    cause: Cause
    reason: str = Field(max_length=512)


class ClientHeartbeat(_Message):
    """Sent at least every second; the service answers with its own. It maps the clocks and shows a live link."""

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


class Watching(_Message):
    """New frames of both fingers show no reason to stop: the client moves while the newest is younger than its lease.

    ``frame_captured_ns``: capture of the newest judged frame, of the finger whose frame is older; ``judged_ns``: sent.
    """

    type: Literal["watching"] = "watching"
    attempt: Attempt
    frame_captured_ns: int
    judged_ns: int


class Slip(_Message):
    """Incipient slip: stop the arm now. ``age_ms`` is the time from the frame's capture to this message."""

    type: Literal["slip"] = "slip"
    attempt: Attempt
    finger: Finger
    frame_seq: int
    captured_ns: int
    age_ms: float
    score: float
    reason: str
    pressed_mm: float | None = None  # by that frame; None where no contact is known


class Correction(_Message):
    """Retract, then move by (dx_mm, dtheta_deg) in the work-object frame. ``turns_deg``: measured by each finger."""

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
    """No correction can be trusted for this attempt; the client must not guess one. ``turns_deg``: see `Correction`."""

    type: Literal["no_decision"] = "no_decision"
    attempt: Attempt
    reason: NoDecisionReason
    detail: str
    turns_deg: tuple[float, float] | None = None


class Finished(_Message):
    """The insertion is closed and its recording complete. Only the outcome ``inserted`` is an insertion.

    ``doubts``: for ``not_confirmed``, why full depth is not claimed (if only for a turned object, a client that
    regrasps gets ``regrasped``); for ``unwatched``, why frames that came were not judged.
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
    """Answer to a heartbeat, with its count. ``frame_age_ms``: of the finger whose newest frame is older."""

    type: Literal["heartbeat"] = "heartbeat"
    count: int
    clock: Clock | None = None
    frame_age_ms: float | None


AttemptMessage = Armed | Straighten | Refused | Watching | Slip | Enough | Correction | NoDecision
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
