"""The web application around a station: an app factory, so that tests and the simulator serve the same application."""

import asyncio

from fastapi import FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.routing import compile_path

from service import __version__
from service.contract import ContractError
from service.session.station import Station
from service.web import asyncapi
from service.web.access import Access
from service.web.metrics import Metrics
from service.web.middleware import Bodies, RequestLimits
from service.web.page.status import Status
from service.web.reading import Reading
from service.web.routes import api, cameras, health, insertion, live, oip, playback, recordings, status, versions

METHOD_NOT_ALLOWED = 405


class Refused(BaseModel):
    """The answer to a refused request: one line with what was wrong and what was expected."""

    error: str


REFUSAL = {"application/json": {"schema": Refused.model_json_schema()}}  # of every route, besides its own answers


def create_app(station: Station) -> FastAPI:
    """The application; the caller starts and stops the station. Raises TokenError if it cannot store its token."""
    app = FastAPI(
        title="tactile-insertion",
        version=__version__,
        docs_url=None,  # its scripts would come from the internet
        redoc_url=None,
        responses={"4XX": {"description": "refused; the text says why", "content": REFUSAL}},
    )
    access = Access(station.settings)
    app.state.station, app.state.access, app.state.bodies = station, access, Bodies()
    app.include_router(health.router(station, Metrics(station)))
    app.include_router(insertion.router(station, access))
    page_status = Status(station)
    app.include_router(live.router(station, access, page_status))
    app.include_router(status.router(page_status, access))
    for module in (api, cameras, oip, versions):
        app.include_router(module.router(station, access))
    reading = Reading(station)
    for looking_back in (playback, recordings):
        app.include_router(looking_back.router(station, access, reading))
    app.mount("/dashboard", StaticFiles(directory=live.FOLDER))
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=station.settings.hosts, www_redirect=False)
    app.add_middleware(RequestLimits, requests_per_s=station.settings.requests_per_s, access=access)
    _refuse_in_one_form(app)
    return app


def warm(app: FastAPI) -> None:
    """Make what the first request for it would make in the event loop, where the robot's messages wait for 0.2 s.

    A request of a wrong method, which needs no token, reads the description; the page's files are read in threads.
    """
    asyncio.run(run_in_threadpool(app.openapi))
    asyncapi.document(__version__)


def _refuse_in_one_form(app: FastAPI) -> None:
    """Every refusal is ``{"error": ...}``, under /v1 as under /v2."""

    @app.exception_handler(ContractError)
    async def broken_contract(_: Request, error: ContractError) -> JSONResponse:
        return JSONResponse({"error": str(error)}, 400)

    @app.exception_handler(HTTPException)
    async def refused(request: Request, error: HTTPException) -> JSONResponse:
        if error.status_code == METHOD_NOT_ALLOWED:
            methods = ", ".join(sorted(allowed_methods(request)))
            error.headers = {"Allow": methods} if methods else error.headers
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return JSONResponse({"error": f"{where}: {first['msg']}"}, 422)


def allowed_methods(request: Request) -> set[str]:
    """The methods of a described path: the router itself names only those of its first route."""
    described: dict[str, dict[str, object]] = request.app.openapi()["paths"]
    matching = [methods for path, methods in described.items() if compile_path(path)[0].match(request.scope["path"])]
    return {method.upper() for methods in matching for method in methods}
