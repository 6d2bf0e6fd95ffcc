"""A finger's camera as MJPEG over HTTP, one connection per client, every part stamped with its capture time.

``X-Timestamp`` is the capture time in seconds of the machine's steady clock with nanosecond digits (as camera streamers
stamp frames with the driver's monotonic time), ``X-Sequence`` counts frames.
A slow client loses frames and never delays others: each connection sends the newest frame only.
"""

import asyncio
import contextlib
import random
import socket
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from simulation.cell.emulators.faults import CameraFaults, FaultBoard, take

BOUNDARY = "frame"
_HEADER = (
    "HTTP/1.1 200 OK\r\nConnection: close\r\nCache-Control: no-store\r\nPragma: no-cache\r\n"
    f"Content-Type: multipart/x-mixed-replace; boundary={BOUNDARY}\r\n\r\n"
).encode()
_NOT_FOUND = b"HTTP/1.1 404 Not Found\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
_UNAVAILABLE = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
JPEG_QUALITY = 95


def encode_jpeg(pixels: NDArray[np.uint8]) -> bytes:
    """JPEG bytes of a BGR image uint8 [H, W, 3]."""
    done, buffer = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"image of shape {pixels.shape} cannot be encoded")
    return buffer.tobytes()


@dataclass(frozen=True, slots=True)
class Shot:
    """One encoded frame: bytes, sequence number and capture time (steady clock)."""

    jpeg: bytes
    seq: int
    captured_ns: int

    def part(self, *, stamped: bool = True) -> bytes:
        """The multipart part that carries this frame."""
        seconds, rest = divmod(self.captured_ns, 1_000_000_000)
        stamp = f"X-Timestamp: {seconds}.{rest:09d}\r\n" if stamped else ""
        head = (
            f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(self.jpeg)}\r\n"
            f"{stamp}X-Sequence: {self.seq}\r\n\r\n"
        )
        return head.encode() + self.jpeg + b"\r\n"


class CameraEmulator:
    """HTTP server of one camera; call ``publish`` on its event loop with each new shot.

    The scene's ``dropped_share`` of the frames never arrives; the fault board can raise it.
    """

    def __init__(self, finger: str, board: FaultBoard, dropped_share: float = 0.0) -> None:
        self.finger = finger
        self._dropped_share = dropped_share
        self.published = 0
        self._board = board
        self._newest: Shot | None = None
        self._fresh = asyncio.Condition()
        self._random = random.Random(finger)
        self._server: asyncio.Server | None = None
        self._streams: dict[asyncio.Task[None], asyncio.StreamWriter] = {}
        self._stopped = False

    @property
    def faults(self) -> CameraFaults:
        """This camera's section of the fault board."""
        faults: CameraFaults = getattr(self._board.faults, f"camera_{self.finger}")
        return faults

    @property
    def watched(self) -> bool:
        """True while a client is connected."""
        return bool(self._streams)

    async def start(self, sock: socket.socket) -> None:
        self._server = await asyncio.start_server(self._serve, sock=sock)

    async def stop(self) -> None:
        if self._server is not None:
            self._server.close()
        self._stopped = True
        for writer in self._streams.values():
            writer.transport.abort()
        async with self._fresh:
            self._fresh.notify_all()
        await asyncio.gather(*self._streams, return_exceptions=True)

    def _loses(self, share: float) -> bool:
        """True if this frame is one of those that never arrive."""
        return self._random.random() < share

    async def publish(self, shot: Shot) -> None:
        """Make a shot the newest one and wake the streams."""
        faults = self.faults
        share = max(faults.drop_share, self._dropped_share)
        if faults.stall or (share > 0.0 and self._loses(share)):
            return
        if faults.duplicate and self._newest is not None:
            shot = self._newest
        if take(faults, "garbage_next"):
            shot = Shot(self._random.randbytes(2000), shot.seq, shot.captured_ns)
        if faults.delay_ms:
            await asyncio.sleep(faults.delay_ms / 1000.0)
        async with self._fresh:
            self._newest = shot
            self.published += 1
            self._fresh.notify_all()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._streams[task] = writer
        try:
            request = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 5.0)
            await self._respond(request.split(b"\r\n", 1)[0].decode("latin-1"), writer)
        except (TimeoutError, ConnectionError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass
        finally:
            self._streams.pop(task, None)
            writer.close()
            with contextlib.suppress(ConnectionError, asyncio.CancelledError):
                await writer.wait_closed()

    async def _respond(self, request_line: str, writer: asyncio.StreamWriter) -> None:
        method, _, rest = request_line.partition(" ")
        path = rest.split(" ")[0].split("?")[0]
        if method != "GET" or path not in ("/", "/stream.mjpg"):
            writer.write(_NOT_FOUND)
        elif self.faults.disconnect:
            writer.write(_UNAVAILABLE)
        else:
            writer.write(_HEADER)
            await self._stream(writer)
        await writer.drain()

    async def _stream(self, writer: asyncio.StreamWriter) -> None:
        sent = self.published  # a stream begins with the next frame, never with a stale one
        while not (self._stopped or self.faults.disconnect):
            if await self._newer_than(sent) and self._newest is not None:
                sent = self.published
                writer.write(self._newest.part(stamped=not self.faults.unstamped))
                await writer.drain()

    async def _newer_than(self, sent: int) -> bool:
        """Wait up to a quarter second for a shot other than number ``sent``."""
        async with self._fresh:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._fresh.wait_for(lambda: self._stopped or self.published != sent), 0.25)
        return self.published != sent
