"""Answers leave in one piece, and nothing of them is kept back."""

import asyncio
import socket

import httpx
import pytest

from tests.service.conftest import LiveService

patience_c = pytest.importorskip("service.web.patience_c")  # httptools is optional


class Wire(asyncio.Transport):
    """What a transport was told to do."""

    def __init__(self) -> None:
        super().__init__()
        self.done: list[bytes | str] = []

    def write(self, data: bytes) -> None:
        self.done.append(data)

    def close(self) -> None:
        self.done.append("closed")

    def is_closing(self) -> bool:
        return "closed" in self.done


def gathered(*calls: tuple[str, bytes]) -> list[bytes | str]:
    async def talk() -> list[bytes | str]:
        wire = Wire()
        out = patience_c.Gathered(wire, asyncio.get_running_loop())
        for name, data in calls:
            getattr(out, name)(*([data] if data else []))
        at_once = list(wire.done)
        await asyncio.sleep(0)
        assert not out.is_closing() or "closed" in at_once
        return [*at_once, "then", *wire.done[len(at_once) :]]

    return asyncio.run(talk())


def test_head_and_body_leave_together_as_soon_as_the_answer_is_whole() -> None:
    assert gathered(("write", b"head"), ("write", b"body"), ("flush", b"")) == [b"headbody", "then"]


def test_a_head_whose_body_takes_longer_does_not_wait_for_it() -> None:
    assert gathered(("write", b"head")) == ["then", b"head"]


def test_what_is_large_leaves_at_once() -> None:
    large = bytes(patience_c.MAX_GATHERED_BYTES)
    assert gathered(("write", b"head"), ("write", large), ("write", b"rest")) == [b"head" + large, "then", b"rest"]


def test_nothing_is_lost_on_closing() -> None:
    assert gathered(("write", b"head"), ("close", b"")) == [b"head", "closed", "then"]


def test_pipelined_requests_are_answered_in_order_and_a_broken_one_last(live: LiveService) -> None:
    ask = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
    with socket.create_connection(("127.0.0.1", live.port), 30) as link:
        link.sendall(ask * 2)
        said = b""
        while said.count(b'{"status":"ok"}') < 2:
            said += link.recv(4096)
        link.sendall(b"no request at all\r\n\r\n")
        while piece := link.recv(4096):
            said += piece
    assert said.count(b"HTTP/1.1 200") == 2
    assert said.index(b"HTTP/1.1 400") > said.rindex(b"HTTP/1.1 200")


def test_a_body_that_breaks_off_in_nonsense_is_refused_once(live: LiveService) -> None:
    head = b"POST /v2/models/direction.step/infer HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    with socket.create_connection(("127.0.0.1", live.port), 30) as link:
        link.sendall(head + b"2\r\n{}\r\nnonsense\r\n")
        said = b""
        while piece := link.recv(4096):
            said += piece
    assert said.count(b"HTTP/1.1") == said.count(b"HTTP/1.1 400") == 1


def test_an_answer_to_head_and_one_without_a_body_come(live: LiveService) -> None:
    assert httpx.head(live.url("/dashboard/index.html")).status_code == 200
    assert httpx.get(live.url("/nowhere")).json() == {"error": "Not Found"}
