"""The service's own HTTP interface: /v1."""

import asyncio
from itertools import pairwise
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request
from pydantic import BaseModel, ConfigDict, Field

from service import __version__
from service.contract import FINGERS, ContractError, FramePair, decode_frame, encoded_bytes
from service.contract.frames import Contract
from service.contract.wire import Estimate, ModelEntry
from service.session.sequence import decide
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


class Models(Contract):
    """The loaded models, in the order in which they were found."""

    models: tuple[ModelEntry, ...]


class Insertions(Contract):
    """The insertion under way, if any, and how many were opened since the start."""

    active: str | None
    count: int


class Conditions(BaseModel):
    """What is known of the attempt, as in `arm` and `descending`; a misspelt name must not go unnoticed."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    gap_width_mm: float = Field(default=56.0, gt=0, le=1000)
    grasp_height_mm: float | None = Field(default=None, gt=0, le=500)
    speed_mm_s: float | None = Field(default=None, gt=0, le=1000)


class Estimated(Contract):
    """What the networks say of a recorded sequence: an estimate of the error, and no command."""

    class_probabilities: dict[str, float]
    estimate: Estimate
    confidence: float


def router(station: Station, access: Access) -> APIRouter:
    routes = APIRouter(prefix="/v1", tags=["v1"])
    watch, drive = [access.require("watch")], [access.require("drive")]
    deciding = asyncio.Lock()

    def refuse_while_busy() -> None:
        if station.active is not None or deciding.locked():
            raise HTTPException(409, "busy: an insertion is under way, or another sequence is being decided")

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
    async def decisions(request: Request, conditions: Annotated[Conditions, Query()]) -> Estimated:
        """Body: rectified frames as binary messages (left, right, left, right, ...), from rest to the stop.

        Networks that read depth need the speed of the descent. Not while an insertion is under way.
        """
        refuse_while_busy()
        async with whole_body(request, MAX_BODY_BYTES) as body:
            pairs = _pairs(body, station)
        refuse_while_busy()  # reading it took time
        async with deciding:
            answer = await asyncio.to_thread(decide, station.models, pairs, **conditions.model_dump())
        return Estimated.model_validate(answer.model_dump(include=set(Estimated.model_fields)))

    return routes


def _pairs(body: bytearray, station: Station) -> list[FramePair]:
    spec = station.models.card.frame
    size = encoded_bytes(spec)
    frames_n, rest = divmod(len(body), size)
    if rest or not frames_n or frames_n % 2:
        size_px = f"{spec.width_px} x {spec.height_px}"
        raise ContractError(
            f"body of {len(body)} bytes, expected pairs of encoded frames of {size_px}, {size} bytes each"
        )
    frames = [decode_frame(bytes(body[i * size : (i + 1) * size]), spec) for i in range(frames_n)]
    if [frame.finger for frame in frames] != list(FINGERS) * (frames_n // 2):
        raise ContractError("frames must alternate left, right")
    pairs = [FramePair(*both) for both in zip(frames[::2], frames[1::2], strict=True)]
    if any(one.captured_ns >= later.captured_ns for one, later in pairwise(pairs)):
        raise ContractError("the stamps of the pairs do not rise; expected the time at which each was captured, ns")
    return pairs
