"""A gripper that stays connected from one probe to the next, so that it knows that it holds the object."""

from robot_client.insertion.events import Event, Failure, PartLost
from robot_client.ports import Gripper, Post


class KeptGripper(Gripper):
    """Port over another gripper's: `close` lets go of the events only, `leave` of the connection.

    A gripper that is disconnected ends its watch over the part, and takes itself for idle afterwards.
    """

    def __init__(self, gripper: Gripper) -> None:
        self._gripper = gripper
        self._post: Post | None = None
        self._missed: Event | None = None
        self._started = False
        self._reached = False  # there may be a connection, also where its start failed

    @property
    def held(self) -> bool:
        return self._gripper.held

    async def start(self, post: Post) -> None:
        """Connect, the first time; report what failed since the last probe. Raises DriverError."""
        self._post, self._reached = post, True
        if not self._started:
            await self._gripper.start(self._forward)
            self._started = True
        elif self._missed:
            post(self._missed)

    async def connect(self) -> None:
        self._reached = True
        await self._gripper.connect()

    def grasp(self) -> None:
        self._gripper.grasp()

    async def close(self) -> None:
        """Stay connected, and keep a failure for the next probe."""
        self._post = None

    async def leave(self) -> None:
        """Leave the fingers in place and release the connection, if there has been one."""
        if self._reached:
            await self._gripper.close()

    def _forward(self, event: Event) -> None:
        if isinstance(event, Failure | PartLost):
            self._missed = event  # also if a probe hears it: it may have ended already
        if self._post:
            self._post(event)
