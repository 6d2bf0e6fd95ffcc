"""The backup stop ends in words, whatever the controller answers."""

import asyncio

import httpx
import pytest

from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.abb_rws.generation import RwsError
from robot_client.robots.abb_rws.rws1 import RWS1
from robot_client.robots.abb_rws.settings import RwsSettings


@pytest.mark.parametrize("challenge", ["algorithm=SHA3, qop=auth", "algorithm=MD5, qop=auth-int", "qop=banana"])
def test_a_stop_that_cannot_even_be_asked_for_is_not_confirmed_in_words(challenge):
    def answer(_request):
        return httpx.Response(401, headers={"WWW-Authenticate": f'Digest realm="r", nonce="n", {challenge}'})

    async def story():
        client = RwsClient(RwsSettings(stop_timeout_s=0.05, poll_s=0.01))
        await client._client.aclose()
        client._generation, client._auth = RWS1, httpx.DigestAuth("user", "password")
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://127.0.0.1")
        outcome = await client.stop_program()
        with pytest.raises(RwsError, match="GET /rw/panel/opmode"):
            await client.status()
        await client.close()
        return outcome

    assert "STOP NOT CONFIRMED" in asyncio.run(story())


def start_of(panel):
    """Outcome of a start on a controller in this state, the posted requests, and whether the stop is our duty."""
    state, posted = {"opmode": "AUTO", "ctrlstate": "motoron", "ctrlexecstate": "stopped"} | panel, []

    def answer(request):
        if request.method == "POST":
            posted.append(request.url.params["action"])
            state.update({"ctrlexecstate": "running"} if posted[-1] == "start" else {"ctrlstate": "motoron"})
        return httpx.Response(200, json={"_embedded": {"_state": [{**state, "speedratio": "100"}]}})

    async def story():
        client = RwsClient(RwsSettings(start_timeout_s=0.05, motors_timeout_s=0.05, poll_s=0.01))
        await client._client.aclose()
        client._generation = RWS1
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://127.0.0.1")
        try:
            await client.start_program()
            return "", posted, client.started
        except RwsError as error:
            return str(error), posted, client.started
        finally:
            await client._client.aclose()

    return asyncio.run(story())


def test_a_fit_controller_runs_the_program_which_is_then_ours_to_stop():
    assert start_of({}) == ("", ["start"], True)


@pytest.mark.parametrize(
    ("panel", "reason"),
    [
        ({"opmode": "MANR"}, "operating mode is MANR, expected AUTO"),
        ({"ctrlstate": "guardstop"}, "controller state is guardstop"),
        ({"ctrlexecstate": "running"}, "runs already"),
    ],
)
def test_nothing_is_started_on_a_controller_that_is_not_fit_for_it(panel, reason):
    error, posted, started = start_of(panel)
    assert reason in error
    assert (posted, started) == ([], False)


@pytest.mark.parametrize("refused_n", [0, 1, 3])
def test_a_stop_that_was_refused_is_asked_for_again_until_the_controller_reports_it(refused_n):
    state, asked = {"ctrlexecstate": "running"}, []

    def answer(request):
        if request.method == "POST":
            asked.append(request.url.params["action"])
            if len(asked) <= refused_n:
                return httpx.Response(503)
            state["ctrlexecstate"] = "stopped"
        return httpx.Response(200, json={"_embedded": {"_state": [state]}})

    async def story():
        client = RwsClient(RwsSettings(stop_timeout_s=10.0, poll_s=0.01))
        await client._client.aclose()
        client._generation = RWS1
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://127.0.0.1")
        try:
            return await client.stop_program()
        finally:
            await client._client.aclose()

    assert asyncio.run(story()) == "controller confirms: program stopped"
    assert asked == ["stop"] * (refused_n + 1)


def test_an_exchange_that_never_ends_is_given_up():
    """As of a controller that sends its answer byte by byte, each of them in time."""

    async def answer(_request):
        await asyncio.Event().wait()

    async def story():
        client = RwsClient(RwsSettings(request_timeout_s=0.01))
        await client._client.aclose()
        client._generation = RWS1
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://127.0.0.1")
        try:
            with pytest.raises(RwsError, match="GET /rw/panel/opmode: TimeoutError"):
                await asyncio.wait_for(client.status(), 5.0)
        finally:
            await client._client.aclose()

    asyncio.run(story())
