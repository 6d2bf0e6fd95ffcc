"""The WebSocket to the decision service: one connection is one insertion.

Messages go out in order from a queue; incoming ones are parsed strictly and posted as events. Heartbeats run both ways:
a service that does not answer them is a lost link, even while TCP still holds.
"""

import asyncio
import contextlib
import http
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from robot_client.insertion.events import Failure, FromService
from robot_client.ports import DriverError, Post
from robot_client.silence import Silence
from service.contract import wire
from service.contract.frames import Contract, ContractError
from service.contract.token import TOKEN_FILE, is_here, read_token, state_folder

MOST_WAITING = 32  # messages; a longer queue would delay reports of stops too much


class ServiceSettings(Contract):
    """Address, token and allowed silence of the service.

    ``token_file`` holds the token for driving; without it, that of this user's service on this machine is used.
    """

    url: str = Field(default="ws://127.0.0.1:8000/v1/insertion", pattern=r"^wss?://[^/\s]+(/\S*)?$")
    token_file: Path | None = None
    connect_timeout_s: float = Field(default=3.0, gt=0)
    heartbeat_s: float = Field(default=0.1, gt=0, le=1.0)
    silence_s: float = Field(default=0.75, gt=0, le=30)

    @model_validator(mode="after")
    def _is_heard_in_time(self) -> Self:
        if not self.silence_s > self.heartbeat_s:
            raise ValueError(f"silence_s = {self.silence_s:g}, expected more than heartbeat_s = {self.heartbeat_s:g}")
        return self

    def token(self) -> str | None:
        """The token for driving, None if none is found; raises DriverError if its file is unusable."""
        if self.token_file is None and not is_here(self.url):
            return None
        try:
            return read_token(self.token_file or state_folder() / TOKEN_FILE)
        except OSError as error:
            if self.token_file is None:
                return None
            raise DriverError(f"service: service.token_file {self.token_file}: {error.strerror}") from None
        except ContractError as error:
            raise DriverError(f"service: {error}") from None


@dataclass(slots=True)
class ServiceLink:
    """DecisionService port over WebSocket."""

    settings: ServiceSettings
    insertion_id: str
    _post: Post | None = None
    _connection: ClientConnection | None = None
    _outbox: asyncio.Queue[wire.ClientMessage] = field(default_factory=asyncio.Queue)
    _tasks: list[asyncio.Task[None]] = field(default_factory=list)
    _silence: Silence = field(init=False)
    _greeted: bool = False
    _left_out_n: int = 0

    def __post_init__(self) -> None:
        self._silence = Silence(self.settings.silence_s, self.settings.heartbeat_s)

    async def start(self, post: Post) -> None:
        """Connect; raises DriverError."""
        self._post = post
        settings, token = self.settings, self.settings.token()
        try:
            self._connection = await connect(
                settings.url,
                additional_headers={"Authorization": f"Bearer {token}"} if token else None,
                compression=None,
                open_timeout=settings.connect_timeout_s,
                close_timeout=1.0,
                ping_interval=None,  # our own heartbeat is the stricter one
                max_size=wire.MAX_TEXT_BYTES,
                proxy=None,
            )
        except InvalidStatus as error:
            refused = error.response.status_code == http.HTTPStatus.FORBIDDEN
            why = "its token (service.token_file) or the path of the address is wrong" if refused else str(error)
            raise DriverError(f"service: {settings.url} refuses this client: {why}") from None
        except (OSError, TimeoutError, WebSocketException, ValueError) as error:
            raise DriverError(f"service: cannot connect to {settings.url}: {type(error).__name__} {error}") from None
        self._silence.heard(time.monotonic())
        for work in (self._receive(), self._send(), self._beat()):
            self._tasks.append(asyncio.get_running_loop().create_task(work))

    def send(self, message: wire.ClientMessage) -> None:
        """Queue a message; messages only for the recording are dropped, and counted, if the connection is too slow."""
        if isinstance(message, wire.Telemetry):
            if self._outbox.qsize() >= MOST_WAITING:
                self._left_out_n += len(message.samples)
                return
            message, self._left_out_n = message.model_copy(update={"left_out_n": self._left_out_n}), 0
        self._outbox.put_nowait(message)

    async def close(self) -> None:
        self._post = None
        if self._connection is None:
            return
        self._tasks.append(asyncio.create_task(self._outbox.join()))
        # a sender or receiver that has ended sends nothing more: do not wait for the rest
        await asyncio.wait(self._tasks, timeout=1.0, return_when=asyncio.FIRST_COMPLETED)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        with contextlib.suppress(WebSocketException, OSError, TimeoutError):
            await asyncio.wait_for(self._connection.close(), 2.0)

    async def _receive(self) -> None:
        assert self._connection is not None
        try:
            async for text in self._connection:
                now_s = time.monotonic()
                message = wire.parse_service(text)
                self._silence.heard(now_s)
                self._greeted = self._greeted or isinstance(message, wire.ServiceHello)
                if self._post is not None:
                    self._post(FromService(at_s=now_s, message=message))
            self._fail("link", "the service closed the connection")
        except ContractError as error:
            self._fail("protocol", f"unreadable message: {error}")
        except ConnectionClosed as error:
            self._fail("link", f"connection lost: {error}")
        except Exception as error:  # a defect of ours must not leave the arm moving unwatched
            self._fail("internal", f"{type(error).__name__}: {error}")
            raise

    async def _send(self) -> None:
        assert self._connection is not None
        while True:
            message = await self._outbox.get()
            try:
                await self._connection.send(message.model_dump_json())
            except ConnectionClosed as error:
                self._fail("link", f"connection lost: {error}")
                return
            finally:
                self._outbox.task_done()

    async def _beat(self) -> None:
        """Heartbeats once greeted; silence counts from the last message of any kind."""
        count = 0
        while True:
            await asyncio.sleep(self.settings.heartbeat_s)
            if not self._greeted:
                continue
            count += 1
            now_ns = time.monotonic_ns()
            self.send(wire.ClientHeartbeat(insertion_id=self.insertion_id, count=count, sent_ns=now_ns))
            silent_s = self._silence.over(time.monotonic())
            if silent_s is not None:
                self._fail("silent", f"no message for {silent_s * 1e3:.0f} ms")

    def _fail(self, code: str, detail: str) -> None:
        if self._post is not None:
            post, self._post = self._post, None
            post(Failure(at_s=time.monotonic(), source="service", code=code, detail=detail))
