"""Who listens for slip must not fall silent unheard."""

import asyncio
from pathlib import Path

import pytest
from websockets.asyncio.server import serve

from robot_client.insertion.events import Failure
from robot_client.ports import DriverError
from robot_client.session.service_link import ServiceLink, ServiceSettings
from service.contract.token import keep_token
from service.contract.wire import Abort
from tests.robot_client.insertion.stories import ID, armed, slip


class Script:
    """Stands in for the connection: the service's messages, one after the other."""

    def __init__(self, *messages):
        self.messages = [message.model_dump_json() for message in messages]

    def __aiter__(self):
        return self

    async def __anext__(self):
        if not self.messages:
            raise StopAsyncIteration
        return self.messages.pop(0)


async def test_a_defect_of_ours_in_handling_a_message_is_a_failure_at_once_and_not_a_silence():
    events = []

    def post(event):
        events.append(event)
        if not isinstance(event, Failure):
            raise ZeroDivisionError("a defect")

    link = ServiceLink(ServiceSettings(), ID)
    link._connection, link._post = Script(armed(1), slip(1)), post
    with pytest.raises(ZeroDivisionError):
        await link._receive()
    assert [type(event) for event in events[1:]] == [Failure]
    assert (events[1].source, events[1].code) == ("service", "internal")
    assert "ZeroDivisionError: a defect" in events[1].detail


async def test_what_nobody_takes_any_more_does_not_delay_the_end():
    async with serve(lambda connection: connection.close(), "127.0.0.1", 0) as server:
        port = server.sockets[0].getsockname()[1]
        link = ServiceLink(ServiceSettings(url=f"ws://127.0.0.1:{port}/v1/insertion"), ID)
        await link.start(lambda _event: None)
        await asyncio.sleep(0.05)
        for _ in range(3):
            link.send(Abort(insertion_id=ID, cause="operator", reason="operator: stop: interrupted"))
        await asyncio.wait_for(link.close(), 0.5)


def heard_tokens(settings: ServiceSettings) -> list[str | None]:
    """The Authorization header of a link's handshake, at a real server on a port of its own."""
    heard = []

    async def story() -> None:
        async def handle(connection):
            heard.append(connection.request.headers.get("Authorization"))
            await connection.wait_closed()

        async with serve(handle, "127.0.0.1", 0) as server:
            port = server.sockets[0].getsockname()[1]
            url = settings.url.replace(":9/", f":{port}/")
            link = ServiceLink(settings.model_copy(update={"url": url}), ID)
            await link.start(lambda _: None)
            await link.close()

    asyncio.run(story())
    return heard


def test_the_token_of_a_service_of_this_machine_is_found_and_sent(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TACTILE_STATE", str(tmp_path))
    here = ServiceSettings(url="ws://127.0.0.1:9/v1/insertion")
    assert heard_tokens(here) == [None]
    token, _ = keep_token(tmp_path)
    assert heard_tokens(here) == [f"Bearer {token}"]
    assert heard_tokens(here.model_copy(update={"url": "ws://localhost:9/"})) == [f"Bearer {token}"]
    own, path = keep_token(tmp_path / "another")
    assert heard_tokens(here.model_copy(update={"token_file": path})) == [f"Bearer {own}"]


def test_this_machines_token_goes_to_no_other_machine(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("TACTILE_STATE", str(tmp_path))
    token, path = keep_token(tmp_path)
    for host in ("192.0.2.1", "cell-pc.example", "localhost.example", "127.0.0.1.example", "[2001:db8::1]"):
        assert ServiceSettings(url=f"ws://{host}:8000/").token() is None
        assert ServiceSettings(url=f"ws://{host}:8000/", token_file=path).token() == token


def test_a_token_file_that_is_none_is_named(tmp_path: Path) -> None:
    for content, why in ((None, "No such file"), ("short", "needs 16 or more")):
        path = tmp_path / "token"
        if content:
            path.write_text(content)
        with pytest.raises(DriverError, match=why) as refused:
            ServiceSettings(token_file=path).token()
        assert str(path) in str(refused.value)
