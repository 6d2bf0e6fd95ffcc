"""The service's own HTTP interface: /v1."""

import asyncio
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Query, Request

from service import __version__
from service.contract import FINGERS, ContractError, decode_frame
from service.contract.frames import Contract
from service.contract.wire import Estimate, ModelEntry
from service.decision.evidence import DecisionRun
from service.decision.network_input import network_frames
from service.session.station import Station
from service.web import asyncapi
from service.web.access import Access
from service.web.middleware import whole_body

MAX_BODY_BYTES = 16 << 20
BINARY_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}
GapWidth = Annotated[float, Query(gt=0, le=1000, allow_inf_nan=False)]
GraspHeight = Annotated[float | None, Query(gt=0, le=500, allow_inf_nan=False)]


class Models(Contract):
    """The loaded models, in the order in which they were found."""

    models: tuple[ModelEntry, ...]


class Insertions(Contract):
    """The insertion under way, if any, and how many were opened since the start."""

    active: str | None
    count: int


class Decided(Contract):
    """What the networks say of a recorded sequence: an estimate of the error, and no command."""

    class_probabilities: dict[str, float]
    estimate: Estimate
    confidence: float


def decide(
    station: Station, frames: np.ndarray[Any, np.dtype[np.uint8]], gap_width_mm: float, grasp_height_mm: float | None
) -> Decided:
    """What the networks say of a recorded sequence uint8 [n, 2, H, W, 3]; the first pair is the reference."""
    card = station.models.card
    frames = frames[: card.frames_per_decision]
    inputs = network_frames(card, frames)
    run = DecisionRun(station.models, inputs[0], gap_width_mm, grasp_height_mm)
    for pair in inputs:
        run.step(pair)
    evidence = run.evidence()
    return Decided(
        class_probabilities=evidence.class_probabilities(),
        estimate=evidence.estimate(),
        confidence=evidence.confidence,
    )


def router(station: Station, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1", tags=["v1"])
    watch, drive = [access.require("watch")], [access.require("drive")]

    @routes.get("/models", dependencies=watch)
    async def models() -> Models:
        return Models(models=station.models.entries)

    @routes.get("/asyncapi.json")
    async def websockets() -> dict[str, Any]:
        """The WebSockets, described as AsyncAPI."""
        return asyncapi.document(__version__)

    @routes.get("/insertions", dependencies=watch)
    async def insertions() -> Insertions:
        active = station.active
        return Insertions(active=active.session.insertion_id if active else None, count=station.manager.opened_n)

    @routes.post("/decisions", dependencies=drive, openapi_extra=BINARY_BODY)
    async def decisions(
        request: Request, gap_width_mm: GapWidth = 56.0, grasp_height_mm: GraspHeight = None
    ) -> Decided:
        """Body: encoded frames one after the other (left, right, left, right, ...), rectified."""
        async with whole_body(request, MAX_BODY_BYTES) as body:
            frames = _pairs(body, station)
        return await asyncio.to_thread(decide, station, frames, gap_width_mm, grasp_height_mm)

    return routes


def _pairs(body: bytearray, station: Station) -> np.ndarray[Any, np.dtype[np.uint8]]:
    card = station.models.card
    height, width, channels = card.frame.shape
    needed = 2 * card.frames_per_decision
    size, rest = divmod(len(body), needed)
    if rest or not size:
        raise ContractError(f"body of {len(body)} bytes, expected {needed} encoded frames of {width} x {height}")
    frames = [decode_frame(bytes(body[i * size : (i + 1) * size]), card.frame) for i in range(needed)]
    if [frame.finger for frame in frames] != list(FINGERS) * card.frames_per_decision:
        raise ContractError("frames must alternate left, right")
    return np.stack([frame.pixels for frame in frames]).reshape(-1, 2, height, width, channels)
