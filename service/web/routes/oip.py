"""The Open Inference Protocol under /v2, as stock clients (tritonclient) speak it. Errors are ``{"error": ...}``."""

import asyncio
import gzip
import time
import zlib
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from fastapi import APIRouter, HTTPException, Request, Response
from starlette.datastructures import Headers

from service import __version__
from service.contract import ContractError
from service.decision.models import LoadedModel
from service.session.station import Station
from service.web import oip_tensors
from service.web.access import Access
from service.web.middleware import MAX_BODY_BYTES, whole_body
from service.web.oip_schema import INFERENCE

MAX_WAITING = 32
VERSION = "1"
_OPEN = ThreadPoolExecutor(1, "inference")  # one call at a time: the networks of the insertion keep their core


class Statistics:
    """Successes and failures of each model, with the time they took."""

    def __init__(self) -> None:
        self.count: dict[tuple[str, str], int] = defaultdict(int)
        self.ns: dict[tuple[str, str], int] = defaultdict(int)

    def add(self, model: str, kind: str, started_ns: int) -> None:
        self.count[model, kind] += 1
        self.ns[model, kind] += time.perf_counter_ns() - started_ns

    def of(self, model: str) -> dict[str, Any]:
        kinds = {k: {"count": self.count[model, k], "ns": self.ns[model, k]} for k in ("success", "fail")}
        return {
            "name": model,
            "version": VERSION,
            "inference_count": self.count[model, "success"],
            "execution_count": self.count[model, "success"],
            "inference_stats": kinds,
            "batch_stats": [],
        }


def inflate(body: bytearray, encoding: str) -> bytes | bytearray:
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


def deflate(body: bytes, encoding: str) -> tuple[bytes, dict[str, str]]:
    if encoding == "gzip":
        return gzip.compress(body, 1), {"Content-Encoding": "gzip"}
    if encoding == "deflate":
        return zlib.compress(body, 1), {"Content-Encoding": "deflate"}
    return body, {}


class Inferred(Response):
    """JSON, or JSON followed by binary tensors; the headers say which."""

    media_type = "application/json"


@dataclass(slots=True)
class Served:
    """The loaded models under /v2, and what was asked of them."""

    station: Station
    statistics: Statistics = field(default_factory=Statistics)
    waiting_n: int = 0

    def models(self) -> dict[str, LoadedModel]:
        """Every loaded file by its name without ``.onnx`` (``direction.step``)."""
        return {model.path.name.removesuffix(".onnx"): model for model in self.station.models.models}

    def model(self, name: str, version: str) -> LoadedModel:
        """The model of a name; raises HTTPException 404 with the names there are."""
        models = self.models()
        model = models.get(name)
        if model is None or version != VERSION:
            raise HTTPException(404, f"unknown model {name} version {version}, expected {list(models)}")
        return model

    async def infer(self, request: Request, name: str, version: str) -> Response:
        """Answer an inference request; raises HTTPException or ContractError with the reason if it cannot be done."""
        model = self.model(name, version)
        if self.waiting_n >= MAX_WAITING:
            raise HTTPException(429, f"{MAX_WAITING} inferences wait already", {"Retry-After": "1"})
        started = time.perf_counter_ns()
        self.waiting_n += 1
        try:
            binary = "inference-header-content-length" in request.headers
            async with whole_body(request, MAX_BODY_BYTES if binary else oip_tensors.MAX_JSON_BYTES) as body:
                work = partial(_infer, name, model, request.headers, body)
                content, described = await asyncio.get_running_loop().run_in_executor(_OPEN, work)
        except ContractError:
            self.statistics.add(name, "fail", started)
            raise
        finally:
            self.waiting_n -= 1
        self.statistics.add(name, "success", started)
        return Response(content, headers=described)


def _infer(name: str, model: LoadedModel, headers: Headers, body: bytearray) -> tuple[bytes, dict[str, str]]:
    plain = inflate(body, headers.get("content-encoding", "").strip().lower())
    asked = oip_tensors.parse_request(plain, headers.get("inference-header-content-length"), model)
    try:
        outputs = model.run(asked.inputs)
    except Exception as error:
        raise ContractError(f"{name} refused the inputs: {str(error).splitlines()[0]}") from error
    content, described = oip_tensors.encode_response(name, asked, outputs)
    packed, encoding = deflate(content, wanted_encoding(headers.get("accept-encoding", "")))
    return packed, described | encoding


def router(station: Station, access: Access) -> APIRouter:
    served = Served(station)
    routes = APIRouter(prefix="/v2", tags=["open inference protocol"])
    for add in (_server_routes, _model_routes, _inference_routes):
        add(routes, served, access)
    return routes


def _server_routes(routes: APIRouter, served: Served, access: Access) -> None:
    watch = [access.require("watch")]

    @routes.get("", dependencies=watch)
    async def server() -> dict[str, Any]:
        extensions = ["binary_tensor_data", "statistics", "model_configuration"]
        return {"name": "tactile-insertion", "version": __version__, "extensions": extensions}

    @routes.get("/health/live")
    async def alive() -> dict[str, bool]:
        return {"live": True}

    @routes.get("/health/ready")
    async def ready() -> dict[str, bool]:
        return {"ready": True}  # models are loaded and warm before anything listens

    @routes.get("/models/stats", dependencies=watch)
    async def all_statistics() -> dict[str, Any]:
        return {"model_stats": [served.statistics.of(name) for name in served.models()]}

    @routes.post("/repository/index", dependencies=watch)
    async def index() -> list[dict[str, str]]:
        return [{"name": name, "version": VERSION, "state": "READY", "reason": ""} for name in served.models()]


def _model_routes(routes: APIRouter, served: Served, access: Access) -> None:
    watch = [access.require("watch")]

    @routes.get("/models/{name}", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}", dependencies=watch)
    async def metadata(name: str, version: str = VERSION) -> dict[str, Any]:
        facts = {"name": name, "versions": [VERSION], "platform": "onnxruntime_onnx"}
        return facts | oip_tensors.metadata(served.model(name, version))

    @routes.get("/models/{name}/ready")
    @routes.get("/models/{name}/versions/{version}/ready")
    async def model_ready(name: str, version: str = VERSION) -> dict[str, Any]:
        served.model(name, version)
        return {"name": name, "ready": True}

    @routes.get("/models/{name}/config", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}/config", dependencies=watch)
    async def config(name: str, version: str = VERSION) -> dict[str, Any]:
        return _config(name, served.model(name, version))

    @routes.get("/models/{name}/stats", dependencies=watch)
    @routes.get("/models/{name}/versions/{version}/stats", dependencies=watch)
    async def stats(name: str, version: str = VERSION) -> dict[str, Any]:
        served.model(name, version)
        return {"model_stats": [served.statistics.of(name)]}


def _inference_routes(routes: APIRouter, served: Served, access: Access) -> None:
    drive = [access.require("drive")]

    @routes.post("/models/{name}/infer", dependencies=drive, openapi_extra=INFERENCE, response_class=Inferred)
    @routes.post(
        "/models/{name}/versions/{version}/infer", dependencies=drive, openapi_extra=INFERENCE, response_class=Inferred
    )
    async def infer(request: Request, name: str, version: str = VERSION) -> Response:
        return await served.infer(request, name, version)


def wanted_encoding(accepted: str) -> str:
    """The compression a client asked for; browsers' and libraries' lists of all they know do not count."""
    return accepted.strip() if accepted.strip() in {"gzip", "deflate"} else ""


def _config(name: str, model: LoadedModel) -> dict[str, Any]:
    described = oip_tensors.metadata(model)

    def tensors(kind: str) -> list[dict[str, Any]]:
        return [{"name": t["name"], "data_type": f"TYPE_{t['datatype']}", "dims": t["shape"]} for t in described[kind]]

    inputs, outputs = tensors("inputs"), tensors("outputs")
    return {"name": name, "platform": "onnxruntime_onnx", "max_batch_size": 0, "input": inputs, "output": outputs}
