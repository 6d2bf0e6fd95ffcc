"""The WSG-50 in text mode (GCL, firmware 4, "text based interface" switched on in its web page): same port, same care.

``GRIP(40,50,30)`` and a newline is answered by ``ACK GRIP`` and, when done, ``FIN GRIP``; ``ERR ...`` refuses.
States come unasked as ``@GRIPSTATE=4``. Homing and the gripper's own limits cannot be read.
"""

import asyncio
import contextlib
import math
import re
import time
from dataclasses import dataclass, field

from robot_client.grippers.wsg50.codes import GraspingState
from robot_client.grippers.wsg50.gripper import GripperError, Wsg50
from robot_client.ports import Finding, HomingDirection

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
class TextWsg50(Wsg50):
    """Gripper port in text mode."""

    _width_mm: float | None = None
    _parser: LineParser = field(default_factory=LineParser)
    _answers: asyncio.Queue[str] = field(default_factory=asyncio.Queue)

    async def connect(self) -> None:
        """Connect, have state and width sent by themselves, wait for the first of each; raises GripperError."""
        reader = await self._open()
        assert self._writer is not None
        self._spawn(self._read(reader))
        for name in ("GRIPSTATE", "POS"):
            self._writer.write(encode_call("AUTOSEND", name, self.settings.update_period_ms))
        deadline_s = time.monotonic() + self.settings.reply_timeout_s
        while self.state is None or self._width_mm is None:
            if time.monotonic() > deadline_s:
                where = self.settings.address
                raise GripperError(f"gripper: {where} sends no state; is its text based interface switched on?")
            await asyncio.sleep(0.01)

    async def close(self) -> None:
        """Announce the end (else the gripper latches a fast stop); the fingers stay as they are."""
        self._post = None
        if self._writer is not None:
            self._writer.write(encode_call("BYE"))
            with contextlib.suppress(OSError):
                await self._writer.drain()
            self._writer.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def acknowledge(self) -> None:
        """Clear a latched fault; raises GripperError."""
        await self.call("FSACK")

    async def width_mm(self) -> float:
        """Opening between the fingers, as last sent."""
        assert self._width_mm is not None
        return self._width_mm

    def findings(self) -> list[Finding]:
        """A latched fault, and what text mode leaves out."""
        fault = self._fault()
        return [
            Finding(not fault, f"{fault}: a fault is latched" if fault else "no fault"),
            Finding(True, "text mode: homing and the gripper's own limits cannot be read, see its web page"),
        ]

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

    def _fault(self) -> str:
        return "grasping state ERROR" if self.state is GraspingState.ERROR else ""

    async def _subscribe(self) -> None:
        """Done by :meth:`connect`."""

    async def _home(self, direction: HomingDirection) -> None:
        if direction != "default":
            raise GripperError("gripper: text mode knows one homing direction, the gripper's own; leave it out")
        await self.call("HOME")

    async def _open_fingers(self, width_mm: float) -> None:
        await self.call("MOVE", width_mm, self.settings.grasp_speed_mm_s)
        await self._read_state()

    async def _close_fingers(self) -> None:
        settings = self.settings
        await self.call("GRIP", settings.force_limit_n, settings.grasp_width_mm, settings.grasp_speed_mm_s)
        await self._read_state()

    async def _read_state(self) -> None:
        await asyncio.sleep(2.0 * self.settings.update_period_ms / 1000.0)  # what is sent after FIN, not before

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
            self._width_mm = float(value[2])
            self._on_width(self._width_mm)
        elif value[1] == "GRIPSTATE":
            self._silence.heard(time.monotonic())
            self._on_state(float(value[2]))
