"""The WSG-50 in text mode (GCL, firmware 4, "text based interface" switched on in its web page): same port, same care.

``GRIP(40,50,30)`` and a newline is answered by ``ACK GRIP`` and, when done, ``FIN GRIP``; ``ERR ...`` refuses.
States come unasked as ``@GRIPSTATE=4``. Binary and text mode exclude each other on the device.
"""

import asyncio
import contextlib
import math
import re
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from typing import Any

from robot_client.grippers.wsg50.codec import GraspingState, HomingDirection
from robot_client.grippers.wsg50.driver import GripperError, WsgSettings
from robot_client.insertion.events import Failure, Grasped, PartLost
from robot_client.ports import Post
from robot_client.silence import Silence

_MAX_LINE = 256
_VALUE = re.compile(r"@([A-Z]+)=(-?\d+(?:\.\d+)?)")


def encode_call(name: str, *values: float | str) -> bytes:
    """``NAME(a,b)`` and a newline; raises GripperError for a number that is not finite."""
    texts = []
    for value in values:
        if isinstance(value, float | int) and not math.isfinite(value):
            raise GripperError(f"gripper: {name} with {value}, expected finite numbers")
        texts.append(f'"{value}"' if isinstance(value, str) else f"{value:g}")
    return f"{name}({','.join(texts)})\n".encode("ascii")


@dataclass(slots=True)
class LineParser:
    """Cuts a TCP stream into lines; forgets what grows beyond any answer."""

    _rest: str = ""

    def feed(self, data: bytes) -> list[str]:
        """Lines completed by ``data``, stripped; bytes that are not ASCII become question marks."""
        *lines, self._rest = (self._rest + data.decode("ascii", "replace")).split("\n")
        if len(self._rest) > _MAX_LINE:
            self._rest = ""
        return [line.strip() for line in lines if 0 < len(line.strip()) <= _MAX_LINE]


@dataclass(slots=True)
class GclGripper:
    """Gripper port in text mode."""

    settings: WsgSettings
    state: GraspingState | None = None
    width_mm: float | None = None
    _post: Post | None = None
    _writer: asyncio.StreamWriter | None = None
    _parser: LineParser = field(default_factory=LineParser)
    _answers: asyncio.Queue[str] = field(default_factory=asyncio.Queue)
    _silence: Silence = field(init=False)
    _tasks: set[asyncio.Task[None]] = field(default_factory=set)

    def __post_init__(self) -> None:
        self._silence = Silence(self.settings.silence_s, self.settings.silence_s / 4.0)

    async def start(self, post: Post) -> None:
        """Connect, then watch; raises GripperError, also for a latched fault."""
        await self.connect()
        if self.state is GraspingState.ERROR:
            raise GripperError("gripper: grasping state ERROR; find the cause, then `home --live --acknowledge`")
        self._post = post
        self._spawn(self._watch())

    async def connect(self) -> None:
        """Connect, have state and width sent by themselves, wait for the first of each; raises GripperError."""
        where = f"{self.settings.host}:{self.settings.port}"
        opening = asyncio.open_connection(self.settings.host, self.settings.port)
        try:
            reader, writer = await asyncio.wait_for(opening, self.settings.reply_timeout_s)
        except (OSError, TimeoutError) as error:
            raise GripperError(f"gripper: cannot connect to {where}: {type(error).__name__} {error}".rstrip()) from None
        self._writer = writer
        self._spawn(self._read(reader))
        for name in ("GRIPSTATE", "POS"):
            writer.write(encode_call("AUTOSEND", name, self.settings.update_period_ms))
        deadline_s = time.monotonic() + self.settings.reply_timeout_s
        while self.state is None or self.width_mm is None:
            if time.monotonic() > deadline_s:
                raise GripperError(f"gripper: {where} sends no state; is its text based interface switched on?")
            await asyncio.sleep(0.01)

    async def home(self, direction: HomingDirection = HomingDirection.DEFAULT) -> None:
        """Reference the axis; refuses while something is held, since homing opens the fingers."""
        if direction is not HomingDirection.DEFAULT:
            raise GripperError("gripper: text mode knows one homing direction, the gripper's own; leave it out")
        if self.state is GraspingState.HOLDING:
            raise GripperError("gripper: holds a part; homing would drop it")
        await self.call("HOME")

    async def acknowledge(self) -> None:
        """Clear a latched fault: only ever on an operator's deliberate call."""
        await self.call("FSACK")

    def grasp(self) -> None:
        """Accept a held object as it is; otherwise close on one with the force limit."""
        self._spawn(self._grasp())

    async def close(self) -> None:
        """Say goodbye (else the gripper latches a fast stop); the fingers stay as they are."""
        self._post = None
        if self._writer is not None:
            self._writer.write(encode_call("BYE"))
            with contextlib.suppress(OSError):
                await self._writer.drain()
            self._writer.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def call(self, name: str, *values: float | str) -> None:
        """Send and wait for FIN (FSACK: for ACK, it knows no other); raises GripperError on ERR or silence."""
        if self._writer is None:
            raise GripperError(f"gripper: {name}: not connected")
        self._writer.write(encode_call(name, *values))
        try:
            while True:
                answer = await asyncio.wait_for(self._answers.get(), self.settings.motion_timeout_s)
                if answer in (f"FIN {name}", "ACK FSACK"):
                    return
                if answer.startswith("ERR"):
                    raise GripperError(f"gripper: {answer}")
        except TimeoutError:
            raise GripperError(f"gripper: {name}: no reply in time") from None

    async def _grasp(self) -> None:
        settings = self.settings
        try:
            if self.state is not GraspingState.HOLDING:
                await self.call("GRIP", settings.force_limit_n, settings.grasp_width_mm, settings.grasp_speed_mm_s)
                await asyncio.sleep(2.0 * settings.update_period_ms / 1000.0)  # the state after FIN, not the one before
        except GripperError as error:
            self._fail("grasp", str(error))
            return
        if self.state is not GraspingState.HOLDING:
            name = self.state.name if self.state is not None else "unknown"
            self._fail("grasp", f"gripper: grasping state is {name}, expected HOLDING")
        elif self._post is not None and self.width_mm is not None:
            self._post(Grasped(at_s=time.monotonic(), width_mm=self.width_mm))

    async def _read(self, reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(4096):
                for line in self._parser.feed(data):
                    self._on_line(line)
        self._fail("link", "gripper: the connection is closed")

    def _on_line(self, line: str) -> None:
        value = _VALUE.fullmatch(line)
        if value is None:
            if line.startswith(("FIN ", "ERR ")) or line == "ACK FSACK":
                self._answers.put_nowait(line)
            return
        if value[1] == "POS":
            self.width_mm = float(value[2])
        elif value[1] == "GRIPSTATE":
            self._silence.heard(time.monotonic())
            self._on_state(float(value[2]))

    def _on_state(self, value: float) -> None:
        if value not in tuple(GraspingState):
            self._fail("protocol", f"gripper: grasping state {value:g}, expected 0..7")
            return
        before, self.state = self.state, GraspingState(int(value))
        if self._post is None or self.state is before:
            return
        if self.state is GraspingState.ERROR:
            self._fail("error", "gripper: grasping state ERROR (fast stop or fault)")
        elif before is GraspingState.HOLDING:
            if self.state in (GraspingState.PART_LOST, GraspingState.NO_PART):
                self._post(PartLost(at_s=time.monotonic()))
            else:
                self._fail("released", f"gripper: left HOLDING for {self.state.name} without being told")

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(self.settings.silence_s / 4.0)
            silent_s = self._silence.over(time.monotonic())
            if silent_s is not None:
                self._fail("silent", f"gripper: no grasping state for {silent_s * 1e3:.0f} ms")

    def _fail(self, code: str, detail: str) -> None:
        if self._post is not None:
            post, self._post = self._post, None
            post(Failure(at_s=time.monotonic(), source="gripper", code=code, detail=detail))

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
