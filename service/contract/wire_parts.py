"""What the messages of :mod:`service.contract.wire` are made of: enumerations, clocks, cameras, limits, estimates."""

from typing import Literal

from pydantic import Field

from service.contract.frames import Contract, Finger
from service.contract.model_card import ModelCard

Outcome = Literal["blocked", "inserted", "dropped", "stopped"]
ControllerName = Literal["heuristic", "belief"]
Cause = Literal[
    "operator",  # a person's wish, and the only cause that is no failure
    "attempts",  # as many as allowed, and still blocked
    "unwatched",  # the newest judged frame grew older than the lease
    "part_lost",
    "not_confirmed",  # full depth was reached, and nothing shows that the object came along
    "no_decision",
    "refused",  # the service refused to arm
    "limits",  # a motion, a correction or a plan beyond the client's limits
    "arm",
    "gripper",
    "camera",
    "service",  # a fault of the service, or nonsense from it
    "link",  # the other side fell silent or hung up
    "timeout",
    "client",  # a defect of the client
]
Ending = Literal["inserted", "not_confirmed", "failed", "aborted"]
RefusalReason = Literal["no_reference", "nothing_held", "implausible_width", "late_frames", "not_seen"]
DoubtReason = Literal["push", "not_seen", "not_held", "width", "moved_in_hand", "depth", "order"]


class Clock(Contract):
    """One reading of both clocks: ``sent_ns`` is the client's when it asked, ``service_ns`` the service's answer.

    When the answer is there at ``t`` of the client's clock, the service's showed ``service_ns`` some time within
    [``sent_ns``, ``t``]: so any stamp of the service is known on the client's clock to within one round trip.
    """

    sent_ns: int
    service_ns: int


class ModelEntry(Contract):
    """A loaded model: its card and the SHA-256 of its file."""

    card: ModelCard
    sha256: str


class CameraEntry(Contract):
    """One finger's camera as the service sees it."""

    finger: Finger
    source: str
    state: Literal["live", "stalled", "lost", "starting"]
    frame_rate_hz: float | None = None


class Limits(Contract):
    """The largest correction the service ever sends, and how old a frame may be to decide on."""

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
    """What keeps a claim at full depth from being made, with the figure and its bound where there are such."""

    reason: DoubtReason
    detail: str
    value: float | None = None
    bound: float | None = None
