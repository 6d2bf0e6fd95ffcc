"""The WSG-50's binary protocol over TCP and UDP, and FAST STOP when a TCP client vanishes.

One client at a time. Bytes come from ``robot_client.grippers.wsg50.codec``; what they do from :class:`Gripper`.
"""

import asyncio
import socket
import time
from typing import cast

from simulation.cell.emulators.faults import FaultBoard, take
from simulation.cell.emulators.wsg50_gripper import Gripper
from simulation.cell.emulators.wsg50_session import Session, WsgCounters

TICK_S = 0.005


class Wsg50Emulator:
    """Servers and clock of the gripper.

    The real gripper has one command interface. Here both are open, and datagrams are ignored while a client is
    connected. ``udp_remote_port`` is the port for answers to datagrams, as in the gripper's settings; 0 answers to the
    sender.
    """

    def __init__(self, gripper: Gripper, board: FaultBoard, udp_remote_port: int = 0) -> None:
        self.gripper = gripper
        self.board = board
        self.counters = WsgCounters()
        self.connection: _Connection | None = None
        self._datagrams = _Datagrams(self, udp_remote_port)
        self._server: asyncio.Server | None = None
        self._udp: asyncio.DatagramTransport | None = None
        self._clock: asyncio.Task[None] | None = None

    async def start(self, sock: socket.socket, udp: socket.socket | None = None) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Connection(self), sock=sock)
        if udp is not None:
            self._udp, _ = await loop.create_datagram_endpoint(lambda: self._datagrams, sock=udp)
        self._clock = asyncio.create_task(self._run())

    async def stop(self) -> None:
        if self._clock is not None:
            self._clock.cancel()
            await asyncio.gather(self._clock, return_exceptions=True)
        if self.connection is not None:
            self.connection.abort()
        if self._udp is not None:
            self._udp.close()
        if self._server is not None:
            self._server.close()

    async def _run(self) -> None:
        last_s = time.monotonic()
        while True:
            await asyncio.sleep(TICK_S)
            now_s = time.monotonic()
            self.gripper.advance(min(now_s - last_s, 0.1))
            last_s = now_s
            if self.connection is not None:
                self.connection.session.update(now_s)
                if take(self.board.faults.wsg, "reset_now"):
                    self.connection.abort()
            elif self._datagrams.session is not None:
                self._datagrams.session.update(now_s)


class _Connection(asyncio.Protocol):
    """A TCP client."""

    def __init__(self, emulator: Wsg50Emulator) -> None:
        self._emulator = emulator
        self._transport: asyncio.Transport | None = None
        self.session = Session(emulator.gripper, emulator.board, emulator.counters, self._write, leaves=True)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        if self._emulator.connection is not None or self._emulator.board.faults.wsg.refuse_connections:
            transport.abort()
            return
        self._transport = transport
        self._emulator.connection = self

    def data_received(self, data: bytes) -> None:
        self.session.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:  # noqa: ARG002 asyncio's signature
        """[M] 1.4.2: a client that leaves unannounced is a severe error."""
        if self._emulator.connection is not self:
            return
        self._emulator.connection = None
        if not self.session.announced:
            self._emulator.counters.fast_stops_by_disconnect += 1
            self._emulator.gripper.fast_stop()

    def abort(self) -> None:
        """Cut the connection without a goodbye."""
        if self._transport is not None:
            self._transport.abort()

    def _write(self, message: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(message)


class _Datagrams(asyncio.DatagramProtocol):
    """Clients over UDP ([M] 1.1): the last sender is the client; no disconnection can be noticed, so nothing stops."""

    def __init__(self, emulator: Wsg50Emulator, remote_port: int) -> None:
        self._emulator = emulator
        self._remote_port = remote_port
        self._transport: asyncio.DatagramTransport | None = None
        self._client: tuple[str, int] | None = None
        self.session: Session | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        emulator = self._emulator
        if emulator.connection is not None or emulator.board.faults.wsg.refuse_connections:
            return
        client = (addr[0], self._remote_port or addr[1])
        if self.session is None or client != self._client:
            self._client = client
            self.session = Session(emulator.gripper, emulator.board, emulator.counters, self._write, leaves=False)
        self.session.feed(data)

    def _write(self, message: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(message, self._client)
