"""The service's WebSockets as an AsyncAPI 3 document, generated from the message models."""

from functools import lru_cache
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.contract import FINGERS, wire
from service.web.access import TOKEN

BINARY = "application/octet-stream"
FINGER = {"finger": {"description": "which finger", "enum": list(FINGERS)}}
PAGE = {
    "type": "object",
    "required": ["kind", "content"],
    "properties": {"kind": {"enum": ["status", "finger"]}, "content": {"type": "object"}},
}
SERVER = {
    "host": "127.0.0.1:8000",
    "protocol": "ws",
    "description": "wss where TLS is set up",
    "security": [TOKEN.model.model_dump(mode="json", by_alias=True, exclude_none=True)],
}
FRAME_LAYOUT = (
    "Little-endian header: magic `TIF1`, u8 finger (0 left, 1 right), u8 channels (3), u16 height, u16 width,"
    " u16 reserved, u64 sequence number, u64 capture stamp in ns; then height x width x 3 bytes BGR."
)
_INSERTION: dict[str, Any] = {"insertion_id": "insertion-1"}
_ATTEMPT: dict[str, Any] = _INSERTION | {"attempt": 1}
_CAMERA = wire.CameraEntry(finger="left", source="v4l2:0", state="live", frame_rate_hz=60.0)
_LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)
_CLOCK = wire.Clock(sent_ns=88_000_000_000, service_ns=5_000_000_000)
_SLIP: dict[str, Any] = {"finger": "left", "frame_seq": 141, "captured_ns": 5_000_000_000, "age_ms": 6.5, "score": 1.4}
_CORRECTION: dict[str, Any] = {
    "dx_mm": -6.0,
    "dtheta_deg": 1.5,
    "class_probabilities": {"2": 0.9, "5": 0.1},
    "estimate": wire.Estimate(dx_mm=6.2, dtheta_deg=-1.5, sigma_x_mm=1.1, sigma_theta_deg=2.0),
    "confidence": 0.9,
    "controller": "belief",
    "reason": "belief (+6.1 mm, -1.4 deg) +- (+0.9 mm, +1.8 deg)",
    "latency_ms": {"networks_last_step": 2.4},
}
_POSE = wire.ToolPose(x_mm=8.0, y_mm=0.0, z_mm=35.0, yaw_deg=6.0)
_SAMPLE = wire.RobotSample(at_ns=88_000_000_000, phase="descending", attempt=1, commanded=_POSE, depth_mm=0.1)
EXAMPLES: tuple[BaseModel, ...] = (
    wire.ClientHello(**_INSERTION, client="cell controller 3.1", sent_ns=87_000_000_000),
    wire.Episode(**_INSERTION, object="rectangle", start=_POSE, approach=_POSE, versions={"client": "0.1.0"}),
    wire.Telemetry(**_INSERTION, sent_ns=88_010_000_000, samples=(_SAMPLE,)),
    wire.LearnOpen(**_INSERTION),
    wire.Arm(**_ATTEMPT, gap_width_mm=56.0, expected_depth_mm=25.0, gripper_width_mm=49.6),
    wire.Descending(**_ATTEMPT, speed_mm_s=10.0),
    wire.Stopped(**_ATTEMPT, depth_mm=6.4, outcome="blocked"),
    wire.Abort(**_INSERTION, cause="operator", reason="stopped at the panel"),
    wire.ClientHeartbeat(**_INSERTION, count=7, sent_ns=88_000_000_000),
    wire.ServiceHello(**_INSERTION, models=(), cameras=(_CAMERA,), controller="belief", limits=_LIMITS, clock=_CLOCK),
    wire.OpenLearnt(**_INSERTION),
    wire.Armed(**_ATTEMPT, reference_seq=120, frame_captured_ns=4_300_000_000),
    wire.Straighten(**_ATTEMPT, tilt_deg=-0.6, detail="the attempts have turned it by about 0.9 deg"),
    wire.Refused(**_ATTEMPT, reason="no_reference", detail="left: 12 markers found, expected 420"),
    wire.Watching(**_ATTEMPT, frame_captured_ns=4_366_000_000, judged_ns=4_381_000_000),
    wire.Slip(**_ATTEMPT, **_SLIP, pressed_mm=0.92, reason="slip: 9 markers off the rigid motion"),
    wire.Enough(**_ATTEMPT, frame_seq=139, captured_ns=4_402_331_000, pressed_mm=1.53),
    wire.Correction(**_ATTEMPT, **_CORRECTION),
    wire.NoDecision(**_ATTEMPT, reason="no_motion", detail="neither finger saw the object move"),
    wire.Finished(**_INSERTION, outcome="inserted", attempts=2, recording="recordings/x/insertion.mcap"),
    wire.Fault(**_INSERTION, code="camera_lost", detail="left gone", fatal=False),
    wire.ServiceHeartbeat(**_INSERTION, count=7, clock=_CLOCK, frame_age_ms=12.5),
)


def messages_of(union: Any) -> tuple[type[BaseModel], ...]:
    """The models of a discriminated union of the wire."""
    members: tuple[type[BaseModel], ...] = get_args(get_args(union)[0])
    return members


CLIENT, SERVICE = messages_of(wire.ClientMessage), messages_of(wire.ServiceMessage)


def _message(model: type[BaseModel]) -> dict[str, Any]:
    examples = [{"name": model.__name__, "payload": e.model_dump(mode="json")} for e in EXAMPLES if type(e) is model]
    return {
        "name": model.model_fields["type"].default,
        "title": model.__name__,
        "summary": " ".join((model.__doc__ or "").split()),
        "contentType": "application/json",
        "payload": {"$ref": f"#/components/schemas/{model.__name__}"},
        "examples": examples,
    }


def _channel(address: str, description: str, names: list[str], **more: Any) -> dict[str, Any]:
    messages = {name: {"$ref": f"#/components/messages/{name}"} for name in names}
    return {"address": address, "description": description, "messages": messages} | more


def _operation(action: str, channel: str, summary: str, names: list[str]) -> dict[str, Any]:
    """One operation; ``action`` is from the service's side: it receives the clients' messages."""
    return {
        "action": action,
        "channel": {"$ref": f"#/channels/{channel}"},
        "summary": summary,
        "messages": [{"$ref": f"#/channels/{channel}/messages/{name}"} for name in names],
    }


@lru_cache
def document(version: str) -> dict[str, Any]:
    """The AsyncAPI document; every payload schema is the one that parses its messages."""
    client, service = [m.__name__ for m in CLIENT], [m.__name__ for m in SERVICE]
    _, schemas = models_json_schema(
        [(model, "validation") for model in (*CLIENT, *SERVICE)], ref_template="#/components/schemas/{model}"
    )
    both = {model.__name__: _message(model) for model in (*CLIENT, *SERVICE)}
    for name in both:  # a default in Python, which finds the model of a message by it
        schemas["$defs"][name]["required"] = ["type", *schemas["$defs"][name]["required"]]
    frame = {"Frame": {"name": "frame", "contentType": BINARY, "summary": FRAME_LAYOUT, "payload": {"type": "string"}}}
    summary = "What the page draws: `status` is what GET /v1/status answers, `finger` a picture with its markers."
    page = {"PageEvent": {"name": "page", "contentType": "application/json", "summary": summary, "payload": PAGE}}
    order = " ".join((wire.__doc__ or "").split())
    pushed = "Frames of one finger, pushed in where its camera is `push:`; numbered and stamped as they arrive."
    shown = "Live frames of one finger, newest wins; query max_hz, form=raw or jpeg."
    return {
        "asyncapi": "3.0.0",
        "info": {"title": "tactile-insertion", "version": version, "description": order},
        "defaultContentType": "application/json",
        "servers": {"cell": SERVER},
        "channels": {
            "insertion": _channel("/v1/insertion", "One connection is one insertion.", [*client, *service]),
            "page": _channel("/v1/live", summary, ["PageEvent"]),
            "push": _channel("/v1/cameras/{finger}/push", pushed, ["Frame"], parameters=FINGER),
            "frames": _channel("/v1/cameras/{finger}/frames", shown, ["Frame"], parameters=FINGER),
        },
        "operations": {
            "hearClient": _operation("receive", "insertion", "What a cell controller sends.", client),
            "tellClient": _operation("send", "insertion", "What the service answers and warns of.", service),
            "tellPage": _operation("send", "page", summary, ["PageEvent"]),
            "takeFrames": _operation("receive", "push", pushed, ["Frame"]),
            "showFrames": _operation("send", "frames", shown, ["Frame"]),
        },
        "components": {"messages": both | frame | page, "schemas": schemas["$defs"]},
    }
