"""Those who look on and ask for inference, in a process of their own: they must not hold up what measures.

Each counts what it gets. One that dies or gets nothing fails the benchmark, which would otherwise measure an idle port.
"""

import contextlib
import itertools
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from multiprocessing.synchronize import Event
from typing import Any

import httpx
import numpy as np
from websockets.sync.client import connect

from tests.service.process import ServiceProcess

TYPES: dict[str, type[np.generic]] = {"UINT8": np.uint8, "FP32": np.float32}
BEGUN_S, ANSWER_S, ENDED_S = 60.0, 30.0, 60.0
Got = Callable[[], None]


class CrowdError(RuntimeError):
    """The load that was to be measured under was not there."""


@contextlib.contextmanager
def crowd(service: ServiceProcess, pages: Sequence[str] = (), *, asks: bool = True) -> Iterator[dict[str, Any]]:
    """Viewers of these sockets, and a flood of inference if ``asks``, once each has got something; what they got.

    The facts returned are complete after the context. Raises CrowdError if one had died by then, or got nothing.
    """
    process_of = multiprocessing.get_context("spawn")
    stop, got = process_of.Event(), process_of.Array("q", len(pages) + asks)
    addresses = [service.url(page, "ws") for page in pages]
    what = addresses, service.url("") if asks else "", service.bearer
    process = process_of.Process(target=_crowd, args=(*what, stop, got), daemon=True)
    process.start()
    facts: dict[str, Any] = {"pages": len(pages)}
    try:
        _wait_for(process, lambda: min(got) > 0, BEGUN_S)
        before, began_s = list(got), time.monotonic()
        yield facts
        _wait_for(process, lambda: min(now - was for now, was in zip(got, before, strict=True)) > 0, ANSWER_S)
        rates = [(now - was) / (time.monotonic() - began_s) for now, was in zip(got, before, strict=True)]
        if pages:
            facts["page_messages_per_s"] = round(min(rates[: len(pages)]), 1)
        if asks:
            facts["inferences_per_s"] = round(rates[-1], 1)
    finally:
        stop.set()
        process.join(ENDED_S)
        process.kill()
    if process.exitcode != 0:
        raise CrowdError(f"a viewer or the flood died, see above (exit code {process.exitcode})")


def _wait_for(process: Any, holds: Callable[[], bool], most_s: float) -> None:
    until_s = time.monotonic() + most_s
    while not holds():
        if not process.is_alive() or time.monotonic() > until_s:
            raise CrowdError("a viewer or the flood died, or gets nothing")
        time.sleep(0.05)


def _crowd(pages: list[str], service: str, bearer: dict[str, str], stop: Event, got: Any) -> None:
    def gets(place: int) -> None:
        got[place] += 1

    works = [partial(look, page, stop) for page in pages]
    works += [partial(ask, service, bearer, stop)] if service else []
    with ThreadPoolExecutor(len(works)) as threads:
        running = [threads.submit(_or_stop, stop, work, partial(gets, place)) for place, work in enumerate(works)]
    for one in running:
        one.result()


def _or_stop(stop: Event, work: Callable[[Got], None], gets: Got) -> None:
    """If one of them dies, the others stop too."""
    try:
        work(gets)
    except BaseException:
        stop.set()
        raise


def look(page: str, stop: Event, gets: Got) -> None:
    """Read what a page is sent."""
    with connect(page, compression=None, max_size=None, open_timeout=ANSWER_S, close_timeout=0.2) as link:
        while not stop.is_set():
            link.recv(ANSWER_S)
            gets()


def ask(service: str, bearer: dict[str, str], stop: Event, gets: Got) -> None:
    """Ask the networks that decide for inference, one after the other, without a pause."""
    with httpx.Client(base_url=service, timeout=ANSWER_S, headers=bearer) as client:
        for path, content, length in itertools.cycle([_request(client, name) for name in deciding(client)]):
            if stop.is_set():
                return
            headers = {"Inference-Header-Content-Length": str(length)}
            client.post(f"{path}/infer", content=content, headers=headers).raise_for_status()
            gets()


def deciding(client: httpx.Client) -> list[str]:
    """Names of the networks that the service decides with."""
    models = client.post("/v2/repository/index").raise_for_status().json()
    return [model["name"] for model in models if model["name"].endswith(".step")]


def _request(client: httpx.Client, name: str) -> tuple[str, bytes, int]:
    """Path, body and the length of its JSON, for a network of any inputs."""
    entries, tail = [], b""
    for entry in client.get(f"/v2/models/{name}").raise_for_status().json()["inputs"]:
        shape = [1 if size < 0 else size for size in entry["shape"]]
        values = np.ones(shape, TYPES[entry["datatype"]])
        size = {"binary_data_size": values.nbytes}
        entries.append({"name": entry["name"], "datatype": entry["datatype"], "shape": shape, "parameters": size})
        tail += values.tobytes()
    head = httpx.Request("POST", "http://x", json={"inputs": entries}).content
    return f"/v2/models/{name}", head + tail, len(head)
