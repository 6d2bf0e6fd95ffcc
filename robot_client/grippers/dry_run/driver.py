"""The Gripper port without a gripper."""

import asyncio
import time
from dataclasses import dataclass, field

from robot_client.grippers.dry_run.settings import Settings
from robot_client.insertion.events import Grasped
from robot_client.ports import Check, Gripper, HomingDirection, Post


@dataclass(slots=True)
class DryGripper:
    """Holds as soon as it is asked to."""

    settings: Settings = field(default_factory=Settings)
    _post: Post = field(init=False, repr=False)

    async def start(self, post: Post) -> None:
        """Nothing to connect."""
        self._post = post

    def grasp(self) -> None:
        """Held at once."""
        event = Grasped(at_s=time.monotonic(), width_mm=self.settings.width_mm)
        asyncio.get_running_loop().call_soon(lambda: self._post(event))

    async def close(self) -> None:
        """Nothing to release."""

    def checks(self) -> dict[str, Check]:
        """Nothing to check."""
        return {}

    async def connect(self) -> None:
        """Nothing to connect."""

    async def acknowledge(self) -> None:
        """No fault to clear."""

    async def home(self, direction: HomingDirection) -> float:  # noqa: ARG002 the port's signature
        """Nothing to reference."""
        return self.settings.width_mm


def make(settings: Settings) -> Gripper:
    """The gripper of a rehearsal."""
    return DryGripper(settings)
