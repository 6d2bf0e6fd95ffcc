"""The backup stop ends in words, whatever the controller answers."""

import asyncio
import time

import httpx
import pytest

from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.abb_rws.generation import RwsError
from robot_client.robots.abb_rws.rws1 import RWS1
from robot_client.robots.abb_rws.settings import RwsSettings


def asked(call, state=None, answer=None, **settings):
    """Result of a call on a controller of RobotWare 6 in this state, or the reason for which there is none."""
    panel = {"opmode": "AUTO", "ctrlstate": "motoron", "ctrlexecstate": "stopped", "speedratio": "100"} | (state or {})

    def usual(_request):
        return httpx.Response(200, json={"_embedded": {"_state": [panel]}})

    async def story():
        client = RwsClient(RwsSettings(**{"poll_s": 0.01} | settings))
        await client._client.aclose()
        client._generation = RWS1
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer or usual), base_url="http://127.0.0.1")
        try:
            return await call(client)
        except RwsError as error:
            return str(error)
        finally:
            await client._client.aclose()

    return asyncio.run(story())


@pytest.mark.parametrize("challenge", ["algorithm=SHA3, qop=auth", "algorithm=MD5, qop=auth-int", "qop=banana"])
def test_a_stop_that_cannot_even_be_asked_for_is_not_confirmed_in_words(challenge):
    def answer(_request):
        return httpx.Response(401, headers={"WWW-Authenticate": f'Digest realm="r", nonce="n", {challenge}'})

    async def stopped(client):
        client._auth = httpx.DigestAuth("user", "password")
        outcome = await client.stop_program()
        with pytest.raises(RwsError, match="GET /rw/panel/opmode"):
            await client.status()
        await client.close()
        return outcome

    assert "STOP NOT CONFIRMED" in asked(stopped, answer=answer, stop_timeout_s=0.05)


def start_of(panel):
    """Refusal of a start on a controller in this state, the posted requests, and whether the stop is our duty."""
    state, posted = {"opmode": "AUTO", "ctrlstate": "motoron", "ctrlexecstate": "stopped"} | panel, []

    def answer(request):
        if request.method == "POST":
            posted.append(request.url.params["action"])
            done = {"start": {"ctrlexecstate": "running"}, "setctrlstate": {"ctrlstate": "motoron"}}
            state.update(done.get(posted[-1], {}))
        return httpx.Response(200, json={"_embedded": {"_state": [{**state, "speedratio": "100"}]}})

    clients = []

    async def started(client):
        clients.append(client)
        await client.start_program()

    refusal = asked(started, answer=answer, start_timeout_s=0.05, motors_timeout_s=0.05)
    return refusal, posted, clients[0].started


def test_a_fit_controller_runs_the_program_which_is_then_ours_to_stop():
    assert start_of({}) == (None, ["resetpp", "start"], True)


def test_a_program_that_has_stopped_by_itself_is_confirmed_although_the_controller_refuses_to_stop_it():
    def answer(request):
        status = 200 if request.method == "GET" else 403
        return httpx.Response(status, json={"_embedded": {"_state": [{"ctrlexecstate": "stopped"}]}})

    assert asked(RwsClient.stop_program, answer=answer).startswith("controller confirms: program stopped")


@pytest.mark.parametrize("refused_n", [0, 1, 3])
def test_a_stop_that_was_refused_is_asked_for_again_until_the_controller_reports_it(refused_n):
    state, orders = {"ctrlexecstate": "running"}, []

    def answer(request):
        if request.method == "POST":
            orders.append(request.url.params["action"])
            if len(orders) <= refused_n:
                return httpx.Response(503)
            state["ctrlexecstate"] = "stopped"
        return httpx.Response(200, json={"_embedded": {"_state": [state]}})

    outcome = asked(RwsClient.stop_program, answer=answer, stop_timeout_s=10.0)
    assert outcome == "controller confirms: program stopped"
    assert orders == ["stop"] * (refused_n + 1)


@pytest.mark.parametrize(
    ("state", "switch", "good"),
    [
        ({}, True, [True, True, True, True, True]),
        ({"opmode": "MANR"}, True, [True, False, True, True, True]),
        ({"ctrlstate": "motoroff"}, True, [True, True, True, True, True]),
        ({"ctrlstate": "motoroff"}, False, [True, True, False, True, True]),
        ({"ctrlstate": "motoron"}, False, [True, True, True, True, True]),
        ({"ctrlstate": "guardstop"}, True, [True, True, False, True, True]),
        ({"ctrlexecstate": "running"}, True, [True, True, True, False, True]),
        ({"ctrlexecstate": "running", "ctrlstate": "motoroff"}, True, [True, True, True, False, True]),
    ],
)
def test_what_keeps_a_program_from_being_started_is_found_before_it_is(state, switch, good):
    """Mode, motors and program of the controller; its kind and its speed are only told. Nor are motors left on."""
    findings = asked(RwsClient.findings, state, switch_motors_on=switch)
    assert [finding.good for finding in findings] == good
    assert findings[4].text == "speed ratio 100 %"
    if switch:
        refused, posted, started = start_of(state)
        assert started == (not refused) == bool(posted) == all(good)


@pytest.mark.parametrize(("full", "ratio", "good"), [(False, "50", True), (True, "50", False), (True, "100", True)])
def test_a_program_that_follows_the_speed_ratio_needs_all_of_it(full, ratio, good):
    async def findings(client):
        client.full_speed = full
        return await client.findings()

    assert asked(findings, {"speedratio": ratio})[4].good is good


@pytest.mark.parametrize(("value", "on"), [("0", False), ("0.0", False), ("1.0", True), ("1", True)])
def test_a_digital_signal_is_on_or_off(value, on):
    assert asked(lambda client: client.read_signal("di"), {"lvalue": value}) is on


@pytest.mark.parametrize("value", ["0.37", "nan", "-1", "2", "", "on"])
def test_a_signal_that_is_neither_on_nor_off_starts_nothing(value):
    """An analog signal, named by mistake, was on unless it was nought: a part would begin."""
    assert asked(lambda client: client.read_signal("ai"), {"lvalue": value}) == (
        f"signal ai is {value!r}, expected 0 or 1 of a digital one"
    )


def test_an_answer_without_the_state_that_was_asked_for_is_named():
    for body in ({}, {"_embedded": {"_state": []}}, {"_embedded": {"_state": [{}]}}, []):
        reason = asked(RwsClient.execution, answer=lambda _request, body=body: httpx.Response(200, json=body))
        assert reason.startswith("GET /rw/rapid/execution: answer without ctrlexecstate")


def test_a_refusal_is_told_in_the_controllers_words_where_it_has_some():
    refused = {"_embedded": {"status": {"code": -5, "msg": "not in auto"}}}
    for body, words in ((refused, "HTTP 403: not in auto"), ({"_embedded": {"status": {"code": -5}}}, "HTTP 403: -5")):
        assert asked(RwsClient.execution, answer=lambda _r, body=body: httpx.Response(403, json=body)).endswith(words)
    assert asked(RwsClient.execution, answer=lambda _r: httpx.Response(403, text="no")).endswith("HTTP 403")


@pytest.mark.parametrize(("state", "key"), [({"ctrlstate": "motoroff"}, "ctrlstate"), ({}, "ctrlexecstate")])
def test_a_controller_that_does_not_follow_an_order_is_given_up_once_its_time_is_over(state, key):
    begun_s = time.monotonic()
    timeouts = {"motors_timeout_s": 0.05, "start_timeout_s": 0.05}
    reason = asked(RwsClient.start_program, state, **timeouts)
    assert reason.startswith(f"{key} is ")
    assert "after 0.05 s, expected" in reason
    assert ("look at the pendant" in reason) == (key == "ctrlexecstate")
    assert time.monotonic() - begun_s >= 0.05


@pytest.mark.parametrize(("took_s", "given_up"), [(1.8, False), (2.2, True)])
def test_an_exchange_may_take_twice_the_time_of_one_request(took_s, given_up, monkeypatch):
    """As with digest access, where a refusal comes first. On a clock that runs as the test says."""
    bounded = asyncio.timeout

    async def answer(_request):
        await asyncio.sleep(0.01)
        return httpx.Response(200, json={"_embedded": {"_state": [{"ctrlexecstate": "stopped"}]}})

    def on_time(most_s):
        return bounded(0.0 if most_s < took_s * 0.1 else None)

    monkeypatch.setattr("robot_client.robots.abb_rws.client.asyncio.timeout", on_time)
    assert (asked(RwsClient.execution, answer=answer, request_timeout_s=0.1) == "stopped") == (not given_up)


def test_an_interrupt_at_any_moment_of_a_start_is_not_lost():
    """It may come together with an answer, and the program must not be started after it."""
    state = {"opmode": "AUTO", "ctrlstate": "motoron", "speedratio": "100"}

    async def answer(request):
        await asyncio.sleep(0)
        if request.url.params.get("action") == "start":
            state["ctrlexecstate"] = "running"
        return httpx.Response(200, json={"_embedded": {"_state": [state]}})

    async def interrupted(client, turns):
        state["ctrlexecstate"] = "stopped"
        starting = asyncio.create_task(client.start_program())
        for _ in range(turns):
            await asyncio.sleep(0)
        done = starting.done()
        starting.cancel()
        await asyncio.wait([starting])
        return done, starting.cancelled()

    async def at_every_turn(client):
        return [await interrupted(client, turns) for turns in range(60)]

    ends = asked(at_every_turn, answer=answer)
    assert (ends[0], ends[-1]) == ((False, True), (True, False))
    assert all(cancelled != done for done, cancelled in ends)


def test_only_a_lost_connection_over_http_is_answered_with_the_other_generations_address():
    def lost(_request):
        raise httpx.ConnectError("refused")

    def slow(_request):
        raise httpx.ReadTimeout("slow")

    advice = "RobotWare 7 (OmniCore) is reached by https://"
    assert advice in asked(RwsClient.execution, answer=lost)
    assert advice not in asked(RwsClient.execution, answer=lost, url="https://192.168.125.1")
    assert advice not in asked(RwsClient.execution, answer=slow)


def test_a_session_that_was_never_opened_is_not_closed_and_one_that_was_is_given_back():
    paths = []

    def answer(request):
        paths.append(request.url.path)
        return httpx.Response(200)

    async def story(generation):
        client = RwsClient(RwsSettings())
        await client._client.aclose()
        client._generation = generation
        client._client = httpx.AsyncClient(transport=httpx.MockTransport(answer), base_url="http://127.0.0.1")
        await client.close()
        assert client._client.is_closed

    asyncio.run(story(None))
    assert paths == []
    asyncio.run(story(RWS1))
    assert paths == ["/logout"]
