"""Liveness, readiness and metrics."""

import asyncio

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse, PlainTextResponse

from service.contract import Finger
from service.contract.frames import Contract
from service.session.station import Station
from service.web.metrics import Metrics
from service.web.page.disk import Disk


class Readiness(Contract):
    """Whether insertions can be driven and recorded, and if not, what is in the way."""

    ready: bool
    cameras: dict[Finger, str]
    faults: dict[Finger, str]
    recording: str
    perception: str


def router(station: Station, metrics: Metrics) -> APIRouter:
    """Routes ``/healthz`` (the loop runs), ``/readyz`` (insertions can be driven), ``/metrics`` (Prometheus)."""
    routes, disk = APIRouter(tags=["health"]), Disk(lambda: station.manager.recording_problem)

    @routes.get("/healthz")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @routes.get(
        "/readyz",
        response_model=Readiness,
        responses={503: {"model": Readiness, "description": "not ready; the content says why"}},
    )
    async def readyz() -> JSONResponse:
        cameras = {finger: camera.state for finger, camera in station.cameras.items()}
        faults = {f: camera.last_fault for f, camera in station.cameras.items() if camera.state != "live"}
        problem = await asyncio.to_thread(disk.problem)
        standstill = station.standstill
        ready = station.ready and not problem
        content = {"ready": ready, "cameras": cameras, "faults": faults, "recording": problem or "ok"}
        content["perception"] = standstill or "ok"
        return JSONResponse(content, 200 if ready else 503)

    @routes.get("/metrics", response_class=PlainTextResponse)
    async def exposition() -> Response:
        content, kind = await metrics.exposition()
        return Response(content, media_type=kind)

    return routes
