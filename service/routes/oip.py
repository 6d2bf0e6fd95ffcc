"""The Open Inference Protocol under /v2, as stock clients (tritonclient) speak it. Errors are ``{"error": ...}``."""

import asyncio
import gzip
import time
import zlib
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse

from service import oip
from service.contract import ContractError
from service.models import LoadedModel
from service.routes.access import Access
from service.station import Station

MAX_BODY_BYTES = 256 << 20
_OPEN = ThreadPoolExecutor(1, "inference")  # one call at a time: the networks of the insertion keep their core


class Statistics:
    """Successes and failures of each model, with the time they took."""

    def __init__(self) -> None:
        self.count: dict[tuple[str, str], int] = defaultdict(int)
        self.ns: dict[tuple[str, str], int] = defaultdict(int)

    def add(self, model: str, kind: str, started_ns: int) -> None:
        """One call ended."""
        self.count[model, kind] += 1
        self.ns[model, kind] += time.perf_counter_ns() - started_ns

    def of(self, model: str) -> dict[str, Any]:
        """As the statistics extension reports them."""
        kinds = {k: {"count": self.count[model, k], "ns": self.ns[model, k]} for k in ("success", "fail")}
        return {
            "name": model,
            "version": "1",
            "inference_count": self.count[model, "success"],
            "execution_count": self.count[model, "success"],
            "inference_stats": kinds,
            "batch_stats": [],
        }


def inflate(body: bytes, encoding: str) -> bytes:
    """Undo gzip or deflate, bounded; raise ContractError if it is neither or broken."""
    if encoding in {"", "identity"}:
        return body
    if encoding not in {"gzip", "deflate"}:
        raise ContractError(f"Content-Encoding {encoding}, expected gzip or deflate")
    reader = zlib.decompressobj(31 if encoding == "gzip" else 15)
    try:
        plain = reader.decompress(body, MAX_BODY_BYTES + 1)
    except zlib.error as error:
        raise ContractError(f"body is not {encoding}: {error}") from error
    if len(plain) > MAX_BODY_BYTES:
        raise ContractError(f"body inflates beyond {MAX_BODY_BYTES} bytes")
    return plain


def deflate(body: bytes, accepted: str) -> tuple[bytes, dict[str, str]]:
    """Compress as the client accepts."""
    if "gzip" in accepted:
        return gzip.compress(body, 1), {"Content-Encoding": "gzip"}
    if "deflate" in accepted:
        return zlib.compress(body, 1), {"Content-Encoding": "deflate"}
    return body, {}


def served(station: Station) -> dict[str, LoadedModel]:
    """Every loaded file by its name without ``.onnx`` (``direction.step``)."""
    return {model.path.name.removesuffix(".onnx"): model for model in station.models.models}


def router(station: Station, access: Access) -> APIRouter:  # noqa: C901 - one table of routes
    """Routes under ``/v2``."""
    routes = APIRouter(prefix="/v2", tags=["open inference protocol"])
    watch, drive = [access.require("watch")], [access.require("drive")]
    statistics = Statistics()

    def with_model(name: str, version: str, answer: Callable[[LoadedModel], Any]) -> JSONResponse:
        model = served(station).get(name)
        if model is None or version != "1":
            return JSONResponse(
                {"error": f"unknown model {name} version {version}, expected {list(served(station))}"}, 404
            )
        return JSONResponse(answer(model))

    @routes.get("", dependencies=watch)
    async def server() -> dict[str, Any]:
        extensions = ["binary_tensor_data", "statistics", "model_repository", "model_configuration"]
        return {"name": "tactile-insertion", "version": "0.1.0", "extensions": extensions}

    @routes.get("/health/live")
    async def alive() -> Response:
        return Response()

    @routes.get("/health/ready")
    async def ready() -> Response:
        return Response()

    @routes.get("/models/stats", dependencies=watch)
    async def all_statistics() -> dict[str, Any]:
        return {"model_stats": [statistics.of(name) for name in served(station)]}

    @routes.post("/repository/index", dependencies=watch)
    async def index() -> list[dict[str, str]]:
        return [{"name": name, "version": "1", "state": "READY", "reason": ""} for name in served(station)]

    @routes.post("/repository/models/{name}/{action}", dependencies=[access.require("admin")])
    async def repository(name: str, action: str) -> JSONResponse:
        if action not in {"load", "unload"} or name not in served(station):
            return JSONResponse({"error": f"cannot {action} {name}: expected load of {list(served(station))}"}, 400)
        if action == "unload":
            return JSONResponse({"error": "models that decide insertions are not unloaded; load replaces them"}, 400)
        await asyncio.to_thread(station.reload_models)
        return JSONResponse({})

    @routes.get("/models/{name}", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}", dependencies=watch)
    async def metadata(name: str, version: str = "1") -> JSONResponse:
        facts = {"name": name, "versions": ["1"], "platform": "onnxruntime_onnx"}
        return with_model(name, version, lambda model: facts | oip.metadata(model))

    @routes.get("/models/{name}/ready")
    @routes.get("/models/{name}/versions/{version}/ready")
    async def model_ready(name: str, version: str = "1") -> JSONResponse:
        return with_model(name, version, lambda _: {})

    @routes.get("/models/{name}/config", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}/config", dependencies=watch)
    async def config(name: str, version: str = "1") -> JSONResponse:
        return with_model(name, version, lambda model: _config(name, model))

    @routes.get("/models/{name}/stats", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}/stats", dependencies=watch)
    async def stats(name: str, version: str = "1") -> JSONResponse:
        return with_model(name, version, lambda _: {"model_stats": [statistics.of(name)]})

    @routes.post("/models/{name}/infer", dependencies=drive)
    @routes.post("/models/{name}/versions/{version}/infer", dependencies=drive)
    async def infer(request: Request, name: str, version: str = "1") -> Response:
        model = served(station).get(name)
        if model is None or version != "1":
            return JSONResponse({"error": f"unknown model {name} version {version}"}, 404)
        started = time.perf_counter_ns()
        try:
            answer = await _infer(request, name, model)
        except ContractError as error:
            statistics.add(name, "fail", started)
            return JSONResponse({"error": str(error)}, 400)
        statistics.add(name, "success", started)
        return answer

    return routes


async def _infer(request: Request, name: str, model: LoadedModel) -> Response:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY_BYTES:
            raise ContractError(f"body larger than {MAX_BODY_BYTES} bytes")
    headers = request.headers

    def work() -> tuple[bytes, dict[str, str]]:
        plain = inflate(bytes(body), headers.get("content-encoding", "").strip().lower())
        asked = oip.parse_request(plain, headers.get("inference-header-content-length"), model)
        try:
            outputs = model.run(asked.inputs)
        except Exception as error:
            raise ContractError(f"{name} refused the inputs: {str(error).splitlines()[0]}") from error
        content, described = oip.encode_response(name, asked, outputs)
        packed, encoding = deflate(content, headers.get("accept-encoding", "") if encoded(headers) else "")
        return packed, described | encoding

    content, described = await asyncio.get_running_loop().run_in_executor(_OPEN, work)
    return Response(content, headers=described)


def encoded(headers: Any) -> bool:
    """Whether the client asked for one compression; browsers' and libraries' lists of all they know do not count."""
    return headers.get("accept-encoding", "").strip() in {"gzip", "deflate"}


def _config(name: str, model: LoadedModel) -> dict[str, Any]:
    described = oip.metadata(model)

    def tensors(kind: str) -> list[dict[str, Any]]:
        return [{"name": t["name"], "data_type": f"TYPE_{t['datatype']}", "dims": t["shape"]} for t in described[kind]]

    inputs, outputs = tensors("inputs"), tensors("outputs")
    return {"name": name, "platform": "onnxruntime_onnx", "max_batch_size": 0, "input": inputs, "output": outputs}
