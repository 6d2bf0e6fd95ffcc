"""Liveness, readiness and metrics."""

from fastapi import APIRouter, Response
from fastapi.responses import JSONResponse, PlainTextResponse

from service.session.station import Station
from service.web.metrics import Metrics


def router(station: Station, metrics: Metrics) -> APIRouter:
    """Routes ``/healthz`` (the loop runs), ``/readyz`` (models warm, cameras live), ``/metrics`` (Prometheus)."""
    routes = APIRouter(tags=["health"])

    @routes.get("/healthz")
    async def healthz() -> dict[str, str]:
        return {"status": "ok"}

    @routes.get("/readyz", responses={503: {"description": "not yet: the content says which camera is missing"}})
    async def readyz() -> JSONResponse:
        cameras = {finger: camera.state for finger, camera in station.cameras.items()}
        faults = {f: camera.last_fault for f, camera in station.cameras.items() if camera.state != "live"}
        content = {"ready": station.ready, "cameras": cameras, "faults": faults}
        return JSONResponse(content, 200 if station.ready else 503)

    @routes.get("/metrics", response_class=PlainTextResponse)
    async def exposition() -> Response:
        content, kind = metrics.exposition()
        return Response(content, media_type=kind)

    return routes
