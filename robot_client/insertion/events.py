"""Input (events) and output (commands) of an insertion: plain records that an episode log holds as JSON.

``at_s`` is the client's monotonic clock. None of them accepts non-finite numbers.
"""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Leg, Motion
from service.contract.frames import Contract
from service.contract.wire import ClientMessage, ServiceMessage

Source = Literal["arm", "gripper", "service", "limits", "client", "operator"]


class _Event(Contract):
    at_s: float


class Begin(_Event):
    """Every device is connected; the arm stands at ``pose``. ``held``: the gripper already holds something."""

    kind: Literal["begin"] = "begin"
    pose: WorkPose
    held: bool = False


class Grasped(_Event):
    """The gripper holds the object, fingers ``width_mm`` apart."""

    kind: Literal["grasped"] = "grasped"
    width_mm: float


class Width(_Event):
    """The gripper's fingers are now ``width_mm`` apart."""

    kind: Literal["width"] = "width"
    width_mm: float


class PartLost(_Event):
    """The gripper no longer feels the object."""

    kind: Literal["part_lost"] = "part_lost"


class Arrived(_Event):
    """The commanded move is done and the arm has settled at ``pose`` (measured)."""

    kind: Literal["arrived"] = "arrived"
    pose: WorkPose


class Standstill(_Event):
    """After a hold the arm has come to rest at ``pose`` (measured), and has been there for ``still_s``."""

    kind: Literal["standstill"] = "standstill"
    pose: WorkPose
    still_s: float = Field(default=0.0, ge=0.0)


class Stood(_Event):
    """The descent under way is ``stood_s`` later than planned, because the arm's link had gaps."""

    kind: Literal["stood"] = "stood"
    stood_s: float = Field(ge=0.0)


class FromService(_Event):
    """A message of the decision service."""

    kind: Literal["service"] = "service"
    message: ServiceMessage


class Failure(_Event):
    """A device, a link, a limit or the operator ends the insertion: it holds for good."""

    kind: Literal["failure"] = "failure"
    source: Source
    code: str
    detail: str


class Tick(_Event):
    """Time has passed."""

    kind: Literal["tick"] = "tick"


Event = Annotated[
    Begin | Grasped | Width | PartLost | Arrived | Standstill | Stood | FromService | Failure | Tick,
    Field(discriminator="kind"),
]


class Grasp(Contract):
    """Make sure that the gripper holds the object."""

    kind: Literal["grasp"] = "grasp"


class Move(Contract):
    """Go to ``target`` in a straight line; the driver answers with Arrived.

    ``until_s``: the lease of a descent, after which the driver itself must freeze the target (None: no lease).
    ``legs``: of a descent with several speeds, from top to bottom.
    """

    kind: Literal["move"] = "move"
    target: WorkPose
    motion: Motion
    until_s: float | None = None
    legs: tuple[Leg, ...] = ()


class Renew(Contract):
    """The lease of the descent under way now ends later."""

    kind: Literal["renew"] = "renew"
    until_s: float


class Hold(Contract):
    """Freeze the target at once; the driver answers with Standstill. ``stop`` also stops the controller's program."""

    kind: Literal["hold"] = "hold"
    reason: str
    stop: bool = False


class Send(Contract):
    """Send a message to the decision service; its ``kind`` in a log is "say"."""

    kind: Literal["say"] = "say"
    message: ClientMessage


Command = Annotated[Grasp | Move | Renew | Hold | Send, Field(discriminator="kind")]
MOTION_COMMANDS = (Grasp, Move, Renew)

EVENT: TypeAdapter[Event] = TypeAdapter(Event)
COMMAND: TypeAdapter[Command] = TypeAdapter(Command)
