"""What the runner needs of the world. Orders return at once; what comes of them arrives as events through ``post``.

Each driver reports its own trouble as a Failure event; nothing it does in the background may end silently.
"""

from collections.abc import Callable
from typing import Any, Protocol

from robot_client.insertion.events import Event
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Motion
from service.contract.wire import ClientMessage

Post = Callable[[Event], None]


class DriverError(ValueError):
    """A device could not be made ready; the text says which, what was expected and what to do."""


class Arm(Protocol):
    """A guided arm. After a failure it is latched: it holds and takes no more moves."""

    async def start(self, post: Post) -> WorkPose:
        """Connect, start guidance, and return where the TCP stands; raises DriverError."""

    def move(self, target: WorkPose, motion: Motion) -> None:
        """Begin a straight move; Arrived follows. Raises LimitError if it is not allowed."""

    def hold(self, reason: str, *, stop: bool) -> None:
        """Freeze the target before returning; Standstill follows. ``stop``: end the controller's program too."""

    async def close(self) -> str:
        """Stop the program, wait until the controller confirms, release everything; says how it ended."""

    def position(self) -> WorkPose | None:
        """Where the arm was last measured."""

    def statistics(self) -> dict[str, Any]:
        """Figures of the link for the report (cycles, gaps, stop latency)."""


class Gripper(Protocol):
    """A gripper that holds the object during the whole insertion."""

    async def start(self, post: Post) -> None:
        """Connect and watch the grasp from now on; raises DriverError."""

    def grasp(self) -> None:
        """Make sure the object is held; Grasped follows."""

    async def close(self) -> None:
        """Leave the fingers as they are and release the connection."""


class DecisionService(Protocol):
    """The link to the service that watches for slip and decides the correction."""

    async def start(self, post: Post) -> None:
        """Connect; raises DriverError."""

    def send(self, message: ClientMessage) -> None:
        """Send without waiting."""

    async def close(self) -> None:
        """Send what is still queued and close."""
