"""The web application around a station: an app factory, so that tests and the simulator serve the same thing."""

from collections.abc import Awaitable, Callable

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from service.contract import ContractError
from service.metrics import Metrics
from service.routes import api, health, insertion, live, oip
from service.routes.access import Access
from service.station import Station


def create_app(station: Station) -> FastAPI:
    """The application; the caller starts and stops the station."""
    app = FastAPI(title="tactile-insertion", version="0.1.0", docs_url="/v1/docs", redoc_url=None)
    access = Access(station.settings)
    app.state.station = station
    app.include_router(health.router(station, Metrics(station)))
    app.include_router(insertion.router(station, access))
    app.include_router(live.router(station, access))
    app.include_router(api.router(station, access))
    app.include_router(oip.router(station, access))
    app.mount("/dashboard", live.static_files())

    @app.exception_handler(ContractError)
    async def refused(_: Request, error: ContractError) -> JSONResponse:
        return JSONResponse({"error": str(error)}, 400)

    @app.middleware("http")
    async def hardened(request: Request, proceed: Callable[[Request], Awaitable[Response]]) -> Response:
        response = await proceed(request)
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Cache-Control"] = response.headers.get("Cache-Control", "no-store")
        return response

    return app
