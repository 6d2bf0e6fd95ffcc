"""The parts of the messages in :mod:`service.contract.wire`, the answers to `arm`, and what is only recorded."""

from collections.abc import Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from service.contract.frames import Contract, Finger
from service.contract.model_card import ModelCard

InsertionId = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
MAX_SAMPLES = 64
DEPTH_TOLERANCE_MM = 1.0  # a descent that ends higher above the expected depth is never claimed
MOST_WAITED_NS = 600_000_000_000
Outcome = Literal["blocked", "inserted", "dropped", "stopped"]
ControllerName = Literal["heuristic", "belief"]
CameraState = Literal["live", "stalled", "lost", "starting"]
Cause = Literal[
    "operator",  # a person's wish
    "probed",  # a probe did what it was asked to
    "afresh",  # the object has turned in the hand; the client regrasps it and continues in a new insertion
    "attempts",  # as many as allowed, and still blocked
    "unwatched",  # the newest judged frame grew older than the lease
    "part_lost",
    "not_confirmed",  # full depth was reached, but the evidence for an insertion is missing
    "no_decision",
    "refused",  # the service refused to arm
    "limits",  # a motion, a correction or a plan beyond the client's limits
    "arm",
    "gripper",
    "camera",
    "service",  # a fault of the service, or an invalid message from it
    "link",  # the other side fell silent or disconnected
    "timeout",
    "client",  # a defect of the client
]
Ending = Literal["inserted", "not_confirmed", "failed", "aborted", "probed", "regrasped"]
RefusalReason = Literal["no_reference", "nothing_held", "implausible_width", "turned_in_hand", "untrained"]
NoDecisionReason = Literal[
    "no_motion",
    "out_of_distribution",
    "low_confidence",
    "non_finite",
    "stale",
    "too_few_frames",
    "contradictory",  # the estimates do not follow from the commanded moves: the cell is wired wrong
]
DoubtReason = Literal["push", "not_seen", "not_held", "width", "moved_in_hand", "neighbours", "depth", "order"]
FaultCode = Literal[
    # the connection's, fatal
    "forbidden",
    "busy",
    "taken_over",
    "not_ready",
    "protocol_version",
    "bad_message",  # fatal as the first message only
    # the insertion's, not fatal
    "camera_lost",
    "camera_stalled",
    "camera_frozen",
    "camera_size",
    "stale_frames",
    "open_gel",
    "part_lost",
    "protocol",
    "watch_only",
    "internal",
]


def errors_left(moves: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The error (mm, deg) of each attempt of a successful insertion, to within what fits the gap.

    ``moves`` has the move after each attempt, (0, 0) where there was none. The error of an attempt is the sum of all
    moves after it, with the opposite sign.
    """
    left: list[tuple[float, float]] = []
    x_mm = theta_deg = 0.0
    for dx_mm, dtheta_deg in reversed(moves):
        x_mm, theta_deg = x_mm - dx_mm, theta_deg - dtheta_deg
        left.append((x_mm, theta_deg))
    return left[::-1]


MAX_ATTEMPTS = 15
PRESS_MM = 0.75  # after the touch, unless asked for more or less: docs/decisions/0079-the-depth-of-a-decision.md
Attempt = Annotated[int, Field(ge=1, le=MAX_ATTEMPTS)]


class InsertionMessage(Contract):
    """The field that every message has."""

    insertion_id: InsertionId


class Clock(Contract):
    """One reading of both clocks: ``sent_ns`` is the client's when it asked, ``service_ns`` the service's answer.

    If the answer arrives at ``t`` on the client's clock, the service's clock read ``service_ns`` at some time within
    [``sent_ns``, ``t``]. Any stamp of the service is therefore known on the client's clock to within one round trip.
    """

    sent_ns: int
    service_ns: int


class ModelEntry(Contract):
    """A loaded model: its card and the SHA-256 of its file."""

    card: ModelCard
    sha256: str


class CameraEntry(Contract):
    """State of one finger's camera; ``gel`` names the gel that it was calibrated with, if that is known.

    ``gel_doubt``: why its newest picture does not show that gel open; only a watcher is told, and between insertions.
    """

    finger: Finger
    source: str
    state: CameraState
    frame_rate_hz: float | None = None
    gel: str = Field(default="", max_length=64)
    gel_doubt: str = ""


class Limits(Contract):
    """The largest correction that the service ever sends, and the largest age of a frame for a decision."""

    max_dx_mm: float = Field(gt=0)
    max_dtheta_deg: float = Field(gt=0)
    max_frame_age_ms: float = Field(gt=0)


class Estimate(Contract):
    """The estimated position error before the correction, with one-sigma and 90 % interval where the model gives it."""

    dx_mm: float
    dtheta_deg: float
    sigma_x_mm: float | None = None
    sigma_theta_deg: float | None = None
    interval_x_mm: tuple[float, float] | None = None
    interval_theta_deg: tuple[float, float] | None = None


class Doubt(Contract):
    """A reason why an insertion is not claimed at full depth, with the measured value and its bound if it has them."""

    reason: DoubtReason
    detail: str
    value: float | None = None
    bound: float | None = None


# ---- the record of the episode, which the service keeps and does not use for decisions ------------------------------


class ToolPose(Contract):
    """Pose of the TCP in the work-object frame; ``tilt_deg``: of the tool, as in `Straighten`."""

    x_mm: float
    y_mm: float
    z_mm: float
    yaw_deg: float
    tilt_deg: float = 0.0


class RobotSample(Contract):
    """State of arm and gripper at ``at_ns`` of the client's monotonic clock; None means unknown.

    ``commanded`` is the arm's present target, ``measured`` the pose that it reports. ``depth_mm`` is how far
    ``measured`` is below the pose of the latest `arm`, ``width_mm`` the distance between the fingers.
    """

    at_ns: int
    phase: str = Field(max_length=32)
    attempt: int = Field(ge=0)
    commanded: ToolPose | None = None
    measured: ToolPose | None = None
    depth_mm: float | None = None
    width_mm: float | None = None


class Telemetry(InsertionMessage):
    """States of the robot, sampled 50 times a second and sent in about ten batches a second; recorded, never answered.

    ``sent_ns`` is the client's clock at sending. ``left_out_n`` samples were dropped since the last batch because the
    connection was slow.
    """

    type: Literal["telemetry"] = "telemetry"
    sent_ns: int = Field(ge=0, lt=1 << 62)
    samples: tuple[RobotSample, ...] = Field(max_length=MAX_SAMPLES)
    left_out_n: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _recent(self) -> Self:
        for sample in self.samples:
            if abs(sample.at_ns - self.sent_ns) > MOST_WAITED_NS:
                raise ValueError(f"at_ns = {sample.at_ns} lies more than ten minutes from sent_ns = {self.sent_ns}")
        return self


class Episode(InsertionMessage):
    """The task, for the recording: sent once after `hello`, never answered.

    ``start`` is the pose of the arm, ``approach`` the pose above the gap from which the first attempt descends. A probe
    approaches with a known error and is not meant to insert: its ``approach`` is that error, and ``starts`` are those
    of its attempts after the first, whatever was answered. A press that times the cell (``timing``) begins like a
    probe, but with an object that earlier ones have pushed: nothing is learnt from it.
    In the hand of either an object may hang as it likes. ``simulated``: the cell is; None where a client does not say.
    """

    type: Literal["episode"] = "episode"
    purpose: Literal["insert", "probe", "timing"] = "insert"
    simulated: bool | None = None
    object: str = Field(default="", max_length=128)
    start: ToolPose
    approach: ToolPose
    starts: tuple[ToolPose, ...] = Field(default=(), max_length=MAX_ATTEMPTS - 2)  # the last one would end it
    versions: dict[str, Annotated[str, Field(max_length=128)]] = Field(default_factory=dict, max_length=16)


class Enough(InsertionMessage):
    """The object was pressed as deep as the networks need: stop the arm now, as on slip."""

    type: Literal["enough"] = "enough"
    attempt: Attempt
    frame_seq: int
    captured_ns: int
    pressed_mm: float


class OpenLearnt(InsertionMessage):
    """The appearance of both open gels is learnt; the fingers may close."""

    type: Literal["open_learnt"] = "open_learnt"


class Armed(InsertionMessage):
    """The reference is this frame, and the descent may begin. Its ``frame_captured_ns`` starts the lease."""

    type: Literal["armed"] = "armed"
    attempt: Attempt
    reference_seq: int
    frame_captured_ns: int


class Straighten(InsertionMessage):
    """Instead of armed: the object has turned in the hand. Tilt the tool to ``tilt_deg``, then arm this attempt again.

    ``tilt_deg``: from the vertical, about the axis from the right finger to the left one (y at yaw 0).
    """

    type: Literal["straighten"] = "straighten"
    attempt: Attempt
    tilt_deg: float
    detail: str


class Refused(InsertionMessage):
    """Not armed: no descent. An object that has turned is regrasped, in a new insertion that ``continues`` this one."""

    type: Literal["refused"] = "refused"
    attempt: Attempt
    reason: RefusalReason
    detail: str
