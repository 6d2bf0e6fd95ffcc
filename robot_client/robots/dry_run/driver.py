"""The Arm port without an arm: every order, limit and ramp of the real one, faster than real time."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from robot_client.insertion.events import Arrived, Failure, Standstill
from robot_client.insertion.geometry import CellFrame, WorkPose
from robot_client.insertion.lease import Unwatched
from robot_client.insertion.limits import Leg, LimitError, Limits, Motion
from robot_client.insertion.motion import CYCLE_S, SETTLE_S, MotionGuide, Ramps
from robot_client.ports import Arm, DeviceSettings, Post

_BATCH = 50


class Settings(DeviceSettings):
    """Pose of the TCP at the start."""

    pauses: ClassVar = True
    device: Literal["dry_run"] = "dry_run"
    start: WorkPose = WorkPose(x_mm=0.0, y_mm=0.0, z_mm=75.0, yaw_deg=0.0)

    @property
    def hosts(self) -> tuple[str, ...]:
        return ()


@dataclass(slots=True)
class DryArm(Arm):
    """Follows its targets exactly; ``on_target`` receives each of them."""

    limits: Limits
    ramps: Ramps
    settings: Settings = field(default_factory=Settings)
    on_target: Callable[[WorkPose], None] = lambda _pose: None
    _post: Post = field(init=False, repr=False)
    _guide: MotionGuide = field(init=False)
    _task: asyncio.Task[None] | None = None
    _cycles: int = 0

    def __post_init__(self) -> None:
        self._guide = MotionGuide(self.limits, self.ramps, self.settings.start)

    async def start(self, post: Post) -> WorkPose:
        self._post = post
        self._task = asyncio.get_running_loop().create_task(self._run())
        return self.settings.start

    def move(self, target: WorkPose, motion: Motion, until_s: float | None = None, legs: tuple[Leg, ...] = ()) -> None:
        """Begin a move; raises LimitError if it is not allowed."""
        self._guide.move(target, motion, until_s, legs)

    def renew(self, until_s: float) -> None:
        """Let the descent under way go on until then, in real time."""
        self._guide.renew(until_s)

    def hold(self, reason: str, *, stop: bool) -> None:  # noqa: ARG002 the port's signature
        self._guide.hold()

    async def close(self) -> str:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        return "dry run: no controller"

    def position(self) -> WorkPose | None:
        """The target: the dry arm has no lag."""
        return self._guide.target

    def target(self) -> WorkPose | None:
        return self._guide.target

    def statistics(self) -> dict[str, Any]:
        return {"dry_cycles": self._cycles}

    async def _run(self) -> None:
        while True:
            for _ in range(_BATCH):
                self._cycles += 1
                pose = self._advanced()
                self.on_target(pose)
                settled = self._guide.observe(pose, self._cycles * CYCLE_S)
                if settled:
                    now_s = time.monotonic()
                    still = Standstill(at_s=now_s, pose=pose, still_s=SETTLE_S)
                    self._post(Arrived(at_s=now_s, pose=pose) if settled == "arrived" else still)
                    break
            await asyncio.sleep(0.0 if self._guide.moving else 0.001)

    def _advanced(self) -> WorkPose:
        try:
            return self._guide.advance(CYCLE_S, time.monotonic())
        except LimitError as error:  # as the real arm's driver would refuse
            self._fail("unwatched" if isinstance(error, Unwatched) else "limits", str(error))
            return self._guide.target

    def _fail(self, code: str, detail: str) -> None:
        self._guide.hold()
        self._post(Failure(at_s=time.monotonic(), source="arm", code=code, detail=detail))


def make(settings: Settings, limits: Limits, ramps: Ramps, frame: CellFrame) -> Arm:  # noqa: ARG001 the port's signature
    return DryArm(limits, ramps, settings)
