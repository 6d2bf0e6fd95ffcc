"""The cameras under /v1/cameras: their state, their frames live (MJPEG, WebSocket), and frames pushed in."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import cv2
from fastapi import APIRouter, HTTPException, Query, WebSocket, WebSocketDisconnect
from fastapi.responses import StreamingResponse

from service.cameras.capture import CameraError, CameraFrame
from service.cameras.sources import PushSource
from service.contract import ContractError, Finger, decode_frame, encode_frame
from service.contract.frames import Contract
from service.contract.wire import CameraEntry
from service.perception.identity import doubt
from service.session.station import Station
from service.web.access import Access
from service.web.closing import (
    GOING_AWAY,
    STREAM,
    TRY_AGAIN_LATER,
    UNSUPPORTED,
    Ending,
    close,
    until_gone,
    until_one_ends,
)

BOUNDARY = "frame"
MAX_VIEWERS = 16
_pictures = ThreadPoolExecutor(1, "pictures")  # encoding for viewers never delays deciding for the robot
Form = Literal["raw", "jpeg"]
MaxHz = Annotated[float, Query(gt=0, le=240, allow_inf_nan=False, description="at most so many frames a second")]


class Cameras(Contract):
    """Both fingers' cameras."""

    cameras: tuple[CameraEntry, ...]


class Mjpeg(StreamingResponse):
    media_type = f"multipart/x-mixed-replace; boundary={BOUNDARY}"


def examined(station: Station) -> tuple[CameraEntry, ...]:
    """The cameras' entries after a look at which gels their newest pictures show; takes a tenth of a second."""
    return tuple(
        entry.model_copy(update={"gel_doubt": _gel_doubt(station, entry.finger)}) for entry in station.camera_entries()
    )


def _gel_doubt(station: Station, finger: Finger) -> str:
    calibration, newest = station.manager.calibration, station.cameras[finger].latest
    if calibration is None or newest is None or station.active:  # an insertion holds something: no gel is open
        return ""
    other: Finger = "right" if finger == "left" else "left"
    return doubt(calibration.camera(finger), calibration.camera(other), newest.frame.pixels)


def router(station: Station, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1/cameras", tags=["cameras"])
    watch = [access.require("watch")]
    encoded = Encoded()

    @routes.get("", dependencies=watch)
    async def cameras() -> Cameras:
        return Cameras(cameras=station.camera_entries())

    @routes.get("/{finger}" + STREAM, dependencies=watch, response_class=Mjpeg)
    async def stream(finger: Finger, max_hz: MaxHz = 10.0) -> Mjpeg:
        if station.viewers_n >= MAX_VIEWERS:
            raise HTTPException(429, f"{MAX_VIEWERS} viewers are connected, no more are served")
        return Mjpeg(_parts(station, finger, max_hz, encoded))

    @routes.websocket("/{finger}/frames")
    async def frames(socket: WebSocket, finger: Finger, max_hz: MaxHz = 30.0, form: Form = "raw") -> None:
        if not await access.admit(socket, "watch"):
            return
        await socket.accept()
        if station.viewers_n >= MAX_VIEWERS:
            await close(socket, Ending(TRY_AGAIN_LATER, f"{MAX_VIEWERS} viewers are connected"))
            return
        await _show(socket, station, finger, max_hz, form, encoded)

    @routes.websocket("/{finger}/push")
    async def push(socket: WebSocket, finger: Finger) -> None:
        if not await access.admit(socket, "drive"):
            return
        await socket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            await _take_in(socket, station, finger)

    return routes


async def newest_frames(station: Station, finger: Finger, max_hz: float) -> AsyncIterator[CameraFrame]:
    """The newest frame that the reader lacks, each time it is ready and ``max_hz`` allows; others are skipped."""
    loop = asyncio.get_running_loop()
    arrived = asyncio.Event()

    def on_event(kind: str, content: Any) -> None:
        if kind == "frame" and content.frame.finger == finger:
            with contextlib.suppress(RuntimeError):  # the loop is gone: so is the viewer
                loop.call_soon_threadsafe(arrived.set)

    if station.viewers_n >= MAX_VIEWERS:
        return  # more came at one moment than there is room for
    station.viewers_n += 1
    remove = station.hub.subscribe(on_event)
    try:
        while True:
            await arrived.wait()
            arrived.clear()
            yield station.hub.frames[finger]
            await asyncio.sleep(1 / max_hz - 0.002)
    finally:
        remove()
        station.viewers_n -= 1


@dataclass(slots=True)
class Encoded:
    """The newest frame of each finger in each form, encoded once for all who look on."""

    _newest: dict[tuple[Finger, Form], tuple[int, asyncio.Future[bytes]]] = field(default_factory=dict)

    async def of(self, frame: CameraFrame, form: Form) -> bytes:
        """A frame's bytes: the camera's own JPEG where it sent one, and what this service encodes otherwise."""
        if form == "jpeg" and frame.jpeg is not None:
            return frame.jpeg
        key, stamp = (frame.frame.finger, form), frame.frame.captured_ns
        made = self._newest.get(key)
        if made is None or made[0] < stamp:
            work = (encode_jpeg, frame) if form == "jpeg" else (encode_frame, frame.frame)
            made = stamp, asyncio.get_running_loop().run_in_executor(_pictures, *work)
            self._newest[key] = made
        return await asyncio.shield(made[1])  # one viewer's leaving is no reason for the others to go without


def encode_jpeg(frame: CameraFrame) -> bytes:
    return bytes(cv2.imencode(".jpg", frame.frame.pixels)[1].tobytes())


async def _parts(station: Station, finger: Finger, max_hz: float, encoded: Encoded) -> AsyncIterator[bytes]:
    async for frame in newest_frames(station, finger, max_hz):
        jpeg = await encoded.of(frame, "jpeg")
        head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
        yield head.encode() + jpeg + b"\r\n"


async def _show(
    socket: WebSocket, station: Station, finger: Finger, max_hz: float, form: Form, encoded: Encoded
) -> None:
    async def send() -> Ending:
        async with contextlib.aclosing(newest_frames(station, finger, max_hz)) as shown:  # type: ignore[type-var]
            async for frame in shown:
                await socket.send_bytes(await encoded.of(frame, form))
        return Ending(GOING_AWAY, "no more frames")

    await close(socket, await until_one_ends(socket, send(), until_gone(socket)))


async def _take_in(socket: WebSocket, station: Station, finger: Finger) -> None:
    try:
        source = station.push(finger)
    except ContractError as error:
        await close(socket, Ending(UNSUPPORTED, str(error)))
        return
    if not source.claim():
        await close(socket, Ending(TRY_AGAIN_LATER, f"another client pushes the {finger} camera"))
        return
    try:
        ending = await _pushed(socket, source, finger)
    finally:
        source.release()  # before the close, on which its client may connect again at once
    await close(socket, ending)


async def _pushed(socket: WebSocket, source: PushSource, finger: Finger) -> Ending:
    """Take frames in until one is refused; what else waits on the connection is lost with it."""
    try:
        while True:
            frame = decode_frame(await socket.receive_bytes())
            if frame.finger != finger:
                raise ContractError(f"a frame of the {frame.finger} finger, expected {finger}")
            source.push(frame)
    except KeyError:
        return Ending(UNSUPPORTED, "a text message, expected binary frames")
    except CameraError as error:
        return Ending(TRY_AGAIN_LATER, str(error))
    except ContractError as error:
        return Ending(UNSUPPORTED, str(error))
