"""The cell's own HTTP port: ground truth and faults. No real device has it; tests and the report do use it."""

from collections.abc import Callable
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse

from simulation.cell.emulators.faults import FaultBoard, FaultError


def create_admin(
    readings: dict[str, Callable[[], Any]],
    board: FaultBoard,
) -> FastAPI:
    """Serve ``GET /NAME`` for each reading, ``GET /healthz``, and ``GET|POST|DELETE /faults``."""
    app = FastAPI(openapi_url=None, docs_url=None, redoc_url=None)

    @app.get("/healthz")
    async def health() -> dict[str, str]:
        return {"status": "ok"}

    for name, read in readings.items():
        app.get(f"/{name}")(read)

    @app.get("/faults")
    async def faults() -> dict[str, Any]:
        return board.faults.model_dump()

    @app.post("/faults")
    async def change(request: Request) -> Response:
        try:
            changes = await request.json()
            if not isinstance(changes, dict):
                raise FaultError(f"expected an object of sections, got {type(changes).__name__}")
            return JSONResponse(board.update(changes).model_dump())
        except ValueError as error:
            return JSONResponse({"error": str(error)}, status_code=422)

    @app.delete("/faults")
    async def clear() -> dict[str, Any]:
        return board.clear().model_dump()

    return app
