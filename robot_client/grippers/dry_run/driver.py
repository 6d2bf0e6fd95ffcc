"""The Gripper port without a gripper."""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Literal

from robot_client.insertion.events import Grasped
from robot_client.ports import DeviceSettings, Gripper, Post


class Settings(DeviceSettings):
    """The reported width, in mm."""

    device: Literal["dry_run"] = "dry_run"
    width_mm: float = 50.0  # while it holds

    @property
    def hosts(self) -> tuple[str, ...]:
        return ()


@dataclass(slots=True)
class DryGripper(Gripper):
    """Holds an object on request."""

    settings: Settings = field(default_factory=Settings)
    _post: Post = field(init=False, repr=False)

    async def connect(self) -> None:
        """Nothing to connect."""

    async def start(self, post: Post) -> None:
        self._post = post

    def grasp(self) -> None:
        event = Grasped(at_s=time.monotonic(), width_mm=self.settings.width_mm)
        asyncio.get_running_loop().call_soon(lambda: self._post(event))

    async def width_mm(self) -> float:
        return self.settings.width_mm

    async def release(self, width_mm: float) -> float:
        return width_mm

    async def finds_nothing(self) -> bool:
        """The released object stayed in place."""
        return True

    async def close(self) -> None:
        """Nothing to release."""


make = DryGripper
