"""The connection to a WSG-50: each reply goes to the request that waits for its id, and every one to a listener.

Updates that the gripper sends by itself have the ids of replies, so the listener sees all of them.
"""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from robot_client.grippers.wsg50 import codec
from robot_client.grippers.wsg50.codec import Reply, Value
from robot_client.grippers.wsg50.codes import Command, Status
from robot_client.grippers.wsg50.settings import Settings
from robot_client.ports import DriverError

Request = tuple[Command, tuple[Value, ...]]


class GripperError(DriverError):
    """The gripper refused, failed or fell silent; the text names the request."""


@dataclass(slots=True)
class Link:
    """One connection. ``on_reply``: every reply and update; ``on_end``: why nothing more comes."""

    settings: Settings
    on_reply: Callable[[Reply], None]
    on_end: Callable[[str], None]
    _parser: codec.StreamParser = field(default_factory=codec.StreamParser)
    _opening: asyncio.Task[None] | None = None
    _writer: asyncio.StreamWriter | None = None
    _reader: asyncio.Task[None] | None = None
    _waiting: dict[int, asyncio.Queue[Reply]] = field(default_factory=dict)
    _lost: str = ""

    async def open(self) -> None:
        """Connect; raises GripperError."""
        self._opening = asyncio.get_running_loop().create_task(self._open())
        await asyncio.shield(self._opening)  # an interrupt must leave no connection that nobody announces the end of

    async def close(self, last: Sequence[Request]) -> None:
        """Send the ``last`` requests, whatever becomes of them, and leave."""
        if self._opening is not None:
            await asyncio.wait({self._opening})
        try:
            for command, values in last:
                with contextlib.suppress(GripperError):
                    await self.request(command, *values)
        finally:  # also when whoever closes has waited long enough for a silent gripper
            if self._writer is not None:
                self._writer.close()
                self._writer = None
            if self._reader is not None:
                self._reader.cancel()
                await asyncio.gather(self._reader, return_exceptions=True)

    async def request(self, command: Command, *values: Value) -> Reply:
        """Send and wait for the final reply (the second one of a two-stage command); raises GripperError."""
        if self._writer is None or self._lost:
            raise GripperError(f"gripper: {command.name}: {self._lost or 'not connected'}")
        replies: asyncio.Queue[Reply] = asyncio.Queue()
        self._waiting[command] = replies
        self._writer.write(codec.encode_request(command, *values))
        try:
            async with asyncio.timeout(self.settings.reply_timeout_s):
                reply = await replies.get()
            if reply.status is Status.CMD_PENDING:
                async with asyncio.timeout(self.settings.motion_timeout_s):
                    reply = await replies.get()
        except TimeoutError:
            raise GripperError(f"gripper: {command.name}: no reply in time") from None
        finally:
            self._waiting.pop(command, None)
        if reply.status is not Status.SUCCESS:
            raise GripperError(f"gripper: {command.name}: {self._lost or reply.status.name}")
        return reply

    def take(self, data: bytes) -> None:
        """Handle bytes as they come; frames of another protocol count as nothing, and their request times out."""
        for frame in self._parser.feed(data):
            try:
                reply = codec.decode_reply(frame)
            except codec.WsgError:
                continue
            self.on_reply(reply)
            if reply.command in self._waiting:
                self._waiting[reply.command].put_nowait(reply)

    async def _open(self) -> None:
        opening = asyncio.open_connection(self.settings.host, self.settings.port)
        try:
            reader, self._writer = await asyncio.wait_for(opening, self.settings.reply_timeout_s)
        except (OSError, TimeoutError) as error:
            where, why = self.settings.address, f"{type(error).__name__} {error}".rstrip()
            raise GripperError(f"gripper: cannot connect to {where}: {why}") from None
        self._reader = asyncio.get_running_loop().create_task(self._read(reader))

    async def _read(self, reader: asyncio.StreamReader) -> None:
        try:
            while data := await reader.read(4096):
                self.take(data)
            self._lost = "the gripper closed the connection"
        except OSError as error:
            self._lost = f"connection lost: {error}"
        except Exception as error:  # a defect of ours must not leave a lost part unheard
            self._lost = f"{type(error).__name__}: {error}"
        for queue in self._waiting.values():
            queue.put_nowait(Reply(0, Status.IO_ERROR))
        self.on_end(self._lost)
