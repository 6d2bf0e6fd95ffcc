"""The ports that an insertion needs. Orders return at once; their results arrive as events through ``post``.

Each driver reports its own failures as a Failure event; nothing it does in the background may end silently. Drivers,
service link and state machine share one event loop: an order that blocks keeps all of them from running.
"""

from abc import abstractmethod
from collections.abc import Awaitable, Callable
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

from robot_client.insertion.events import Event
from robot_client.insertion.geometry import WorkPose
from robot_client.insertion.limits import Leg, Motion
from service.contract.frames import Contract
from service.contract.wire import ClientMessage

Post = Callable[[Event], None]
HomingDirection = Literal["default", "outward", "inward"]
NOT_CONFIRMED = "STOP NOT CONFIRMED"
"""How an arm's farewell begins if its controller did not report the stop."""


class DriverError(ValueError):
    """A device could not be made ready; the text names it, the expectation and the remedy."""


class DeviceSettings(Contract):
    """The table of a device in the configuration; ``device`` names its line in :mod:`robot_client.devices`.

    ``variables``: environment variables that replace keys of the table, each with the path to its key. ``grip_key``, of
    a gripper: the key with the force of its fingers in N, "" if it cannot be set; a finding about it begins with it.
    ``pauses``, of an arm: its driver can let a descent stop and go on, and gives it several speeds (:meth:`Arm.move`);
    an insertion then descends fast where nothing can be touched. ``hosts``: those that it is
    reached at; None if it does not say, and then it belongs to no simulated cell.
    """

    variables: ClassVar[dict[str, tuple[str, ...]]] = {}
    grip_key: ClassVar[str] = ""
    pauses: ClassVar[bool] = False
    device: str

    @property
    def address(self) -> str:
        """The address of the device, for display."""
        return self.device

    @property
    def hosts(self) -> tuple[str, ...] | None:
        return None


class Finding(NamedTuple):
    """One result of a check; ``good`` is False if it prevents an insertion."""

    good: bool
    text: str


Check = Callable[[], Awaitable[list[Finding]]]
"""Reads a device and moves nothing; raises ValueError or OSError (as TimeoutError) if it cannot be read."""


class Signals(Protocol):
    """Digital signals of the arm's controller, by name; for a handshake with a PLC."""

    async def read_signal(self, name: str) -> bool:
        """Whether a signal is on; raises DriverError."""

    async def write_signal(self, name: str, *, on: bool) -> None:
        """Switch an output; raises DriverError."""

    async def close(self) -> None:
        """Release the connection."""


class Arm(Protocol):
    """A guided arm. After a failure it is latched: it holds and takes no more moves.

    Its controller stops it, too, once this process is silent: on a PC without power no driver runs.
    """

    @abstractmethod
    async def start(self, post: Post) -> WorkPose:
        """Connect, start guidance, and return the TCP's pose; raises DriverError."""

    @abstractmethod
    def move(self, target: WorkPose, motion: Motion, until_s: float | None = None, legs: tuple[Leg, ...] = ()) -> None:
        """Begin a straight move; Arrived follows, at the target. Raises LimitError if it is not allowed.

        A move that ends elsewhere (:func:`check_arrived`) is a failure.

        ``legs``: of a descent with several speeds, from top to bottom; the last one ends at ``target``. Only an arm
        that ``pauses`` gets them, and has to keep to them: the service takes its depth from its time.

        A descent moves only before ``until_s`` (``time.monotonic``); then the driver itself stops the arm, even if
        nothing else of the client runs any more. Without :meth:`renew` within ``PAUSE_S`` it holds, latched, and
        reports a failure ``unwatched``; at once if the arm cannot stop and go on (:attr:`DeviceSettings.pauses`).
        """

    @abstractmethod
    def renew(self, until_s: float) -> None:
        """Let the descent under way go on until then."""

    @abstractmethod
    def hold(self, reason: str, *, stop: bool) -> None:
        """Freeze the target before returning; Standstill follows. ``stop``: end the controller's program, too.

        Allowed at any time; before :meth:`start` it does nothing.
        """

    @abstractmethod
    async def close(self) -> str:
        """Stop the program, wait until the controller confirms, release everything; returns how it ended.

        The text begins with NOT_CONFIRMED if it does not; half a minute without an end counts as that, too. Allowed
        before :meth:`start`, when there is nothing to stop.
        """

    @abstractmethod
    def position(self) -> WorkPose | None:
        """The last measured pose."""

    def target(self) -> WorkPose | None:
        """The pose presently commanded, None if unknown."""
        return None

    @abstractmethod
    def statistics(self) -> dict[str, Any]:
        """Figures of the link for the report (cycles, gaps, stop latency)."""

    def checks(self) -> dict[str, Check]:
        """The checks of an arm that is not started, by the names printed with their findings."""
        return {}

    def signals(self) -> Signals | None:
        """The controller's signals, usable before :meth:`start`; None for an arm without them."""
        return None


class Gripper(Protocol):
    """A gripper that holds the object during the whole insertion, and also without this process."""

    @property
    def held(self) -> bool:
        """Whether it holds something, as far as it reports; valid after :meth:`start`."""
        return False

    @abstractmethod
    async def start(self, post: Post) -> None:
        """Connect and watch the grasp from now on; raises DriverError. Width follows when the fingers move."""

    @abstractmethod
    def grasp(self) -> None:
        """Make sure the object is held; Grasped follows once it is, or a failure."""

    @abstractmethod
    async def close(self) -> None:
        """Leave the fingers in place and release the connection; allowed before :meth:`start`, when there is none.

        Half a minute without an end is a failure; of an insertion, which is over by then, it changes nothing.
        """

    def checks(self) -> dict[str, Check]:
        """The checks of a gripper that is not started, by the names printed with their findings."""
        return {}

    @abstractmethod
    async def connect(self) -> None:
        """Connect for an operator's command, moving nothing; raises DriverError."""

    async def acknowledge(self) -> None:
        """Clear a latched fault: only ever on an operator's deliberate command; raises DriverError."""
        raise DriverError("gripper: this device has no fault to acknowledge")

    async def width_mm(self) -> float:
        """Distance of the fingers, mm. Only after :meth:`connect`; raises DriverError."""
        raise DriverError("gripper: this device does not tell its width")

    async def release(self, width_mm: float) -> float:  # noqa: ARG002 for devices to use
        """Open to ``width_mm``, releasing a held object; returns the width in mm. Only after :meth:`connect`.

        Raises DriverError, also if the fingers did not get there.
        """
        raise DriverError("gripper: this device has no order to let go")

    async def finds_nothing(self) -> bool:
        """Close as for a grasp, and return whether nothing is between the fingers. Only after :meth:`connect`."""
        raise DriverError("gripper: this device cannot feel whether it is empty")

    async def home(self, direction: HomingDirection) -> float:  # noqa: ARG002 for devices to use
        """Reference the axis and return the width in mm; raises DriverError, also while something is held."""
        raise DriverError("gripper: this device has no homing")


class DecisionService(Protocol):
    """The link to the service that watches for slip and decides the correction."""

    async def start(self, post: Post) -> None:
        """Connect; raises DriverError."""

    def send(self, message: ClientMessage) -> None:
        """Send without waiting."""

    async def close(self) -> None:
        """Send the rest of the queue and close."""
