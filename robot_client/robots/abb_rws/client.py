"""Robot Web Services of an ABB controller, of either generation: state, motors, program start, and the backup stop.

One session (its cookie is kept), every request bounded in time. An accepted stop does not mean stopped: the execution
state is polled until the controller reports it, and the answer names the last report.
"""

import asyncio
import contextlib
import ssl
import time
from collections.abc import Mapping
from typing import Any, Literal

import httpx

from robot_client.ports import NOT_CONFIRMED, Finding
from robot_client.robots.abb_rws.generation import CHALLENGE, Generation, Order, Resource, RwsError, credentials
from robot_client.robots.abb_rws.rws1 import RWS1
from robot_client.robots.abb_rws.rws2 import MEDIA, RWS2
from robot_client.robots.abb_rws.settings import RwsSettings
from service.contract.frames import Contract

GENERATIONS = (RWS1, RWS2)
Cycle = Literal["asis", "once", "forever"]
_START = {
    "regain": "continue",
    "execmode": "continue",
    "condition": "none",
    "stopatbp": "disabled",
    "alltaskbytsp": "true",
}


class ControllerStatus(Contract):
    """State of the controller."""

    operating_mode: str
    controller: str
    execution: str
    speed_ratio: str


class RwsClient:
    """One controller; create it inside the event loop that uses it.

    ``full_speed``: whether its program moves only as fast as ordered where the speed ratio is 100 %. ``cycle``: whether
    it begins anew at its end.
    """

    def __init__(self, settings: RwsSettings, *, full_speed: bool = False, cycle: Cycle = "asis") -> None:
        self.settings = settings
        self.cycle: Cycle = cycle
        self.full_speed = full_speed
        self.started = False
        self._generation: Generation | None = None
        self._auth: httpx.Auth | None = None
        self._client = httpx.AsyncClient(
            base_url=settings.url, timeout=settings.request_timeout_s, trust_env=False, verify=settings.trusted
        )

    async def close(self) -> None:
        """Give the session back (the controller has few) and close the connection."""
        if self._generation is not None:
            with contextlib.suppress(RwsError):  # a lost controller ends the session by itself
                await self._request("GET", "/logout")
        await self._client.aclose()

    async def status(self) -> ControllerStatus:
        """Mode, state, execution and speed ratio; raises RwsError. Moves nothing."""
        return ControllerStatus(
            operating_mode=await self._state("opmode"),
            controller=await self._state("ctrlstate"),
            execution=await self.execution(),
            speed_ratio=await self._state("speedratio"),
        )

    async def findings(self) -> list[Finding]:
        """Whether the controller would allow its program to start; raises RwsError. Moves nothing."""
        status = await self.status()
        motors = status.controller == "motoron" or (status.controller == "motoroff" and self.settings.switch_motors_on)
        return [
            Finding(True, (await self.generation()).name),
            Finding(status.operating_mode == "AUTO", f"operating mode {status.operating_mode} (expected AUTO)"),
            Finding(motors, f"controller {status.controller}"),
            Finding(status.execution == "stopped", f"RAPID {status.execution} (expected stopped)"),
            Finding(self._is_fast(status), f"speed ratio {status.speed_ratio} %{self._of_speed}"),
        ]

    def _is_fast(self, status: ControllerStatus) -> bool:
        return not self.full_speed or float(status.speed_ratio) == 100.0

    @property
    def _of_speed(self) -> str:
        return " (expected 100: the service is told how fast the arm moves)" if self.full_speed else ""

    async def execution(self) -> str:
        """``running`` or ``stopped``."""
        return await self._state("ctrlexecstate")

    async def start_program(self) -> None:
        """Motors on and RAPID running from main; raises RwsError if the controller is not ready or does not follow."""
        status = await self.status()
        if status.operating_mode != "AUTO":
            raise RwsError(f"operating mode is {status.operating_mode}, expected AUTO; turn the key switch")
        if status.controller != "motoron" and (status.controller != "motoroff" or not self.settings.switch_motors_on):
            remedy = "release the stop, then switch the motors on"
            raise RwsError(f"controller state is {status.controller}, expected motoron; {remedy}")
        if not self._is_fast(status):
            raise RwsError(f"speed ratio is {status.speed_ratio} %{self._of_speed}; set it on the pendant")
        if status.execution == "running":
            raise RwsError("the RAPID program runs already; stop it, so that guidance starts from a known state")
        if status.controller != "motoron":
            await self._order("motors", {"ctrl-state": "motoron"})
            await self._until("ctrlstate", "motoron", self.settings.motors_timeout_s)
        # Continued where it was stopped, the program would first take a jogged arm back there.
        await self._order("to_main", {})
        self.started = True  # from here on we have to stop the program, whatever the answer
        await self._order("start", {**_START, "cycle": self.cycle})
        await self._until("ctrlexecstate", "running", self.settings.start_timeout_s, "; look at the pendant")

    async def stop_program(self) -> str:
        """Request a stop and poll until the controller reports it; never raises, returns in words how it ended.

        A controller may refuse the request, as of a program that has stopped by itself: its state counts all the same.
        """
        deadline_s = time.monotonic() + self.settings.stop_timeout_s
        asked, last = False, "no answer"
        while time.monotonic() < deadline_s:
            refused = ""
            try:
                if not asked:
                    await self._order("stop", {"stopmode": "stop"})
                    asked = True
            except RwsError as error:
                refused = str(error)
            try:
                last = await self.execution()
                if last == "stopped":
                    return f"controller confirms: program stopped{await self._why_without_motors()}"
                last = refused or last
            except RwsError as error:
                last, asked = str(error), False
            await asyncio.sleep(self.settings.poll_s)
        return f"{NOT_CONFIRMED} by the controller ({last}): use the stop button"

    async def _why_without_motors(self) -> str:
        """The controller's state if its motors are off, since then the program did not stop for us alone."""
        with contextlib.suppress(RwsError):
            state = await self._state("ctrlstate")
            return "" if state == "motoron" else f", controller {state}"
        return ""

    async def read_signal(self, name: str) -> bool:
        """Whether a digital signal of the controller is on; raises RwsError."""
        value = await self._state("lvalue", name)
        on = {"0": False, "1": True}.get(value.removesuffix(".0"))
        if on is None:
            raise RwsError(f"signal {name} is {value[:80]!r}, expected 0 or 1 of a digital one")
        return on

    async def write_signal(self, name: str, *, on: bool) -> None:
        """Switch a digital output of the controller, whose access level must allow it; raises RwsError."""
        await self._order("signal", {"lvalue": "1" if on else "0"}, name)

    # ---- requests -------------------------------------------------------------------------------------------------

    async def generation(self) -> Generation:
        """The controller's generation, by how it refuses a request without a password; raises RwsError."""
        if self._generation is None:
            refusal = await self._exchange("GET", "/rw", headers={"Accept": f"{MEDIA}, */*"})
            generation = next((known for known in GENERATIONS if known.answered(refusal)), None)
            if generation is None:
                known = " nor ".join(one.name for one in GENERATIONS)
                refused = f"HTTP {refusal.status_code}, {refusal.headers.get(CHALLENGE, 'no question for a password')}"
                raise RwsError(f"{self.settings.url} is neither {known} ({refused[:80]}); check robot.rws.url")
            user, password = self.settings.user, self.settings.password.get_secret_value()
            self._auth = credentials(refusal.headers[CHALLENGE], self.settings.url, user, password)
            self._generation = generation
        return self._generation

    async def _until(self, key: Resource, wanted: str, timeout_s: float, remedy: str = "") -> None:
        deadline_s = time.monotonic() + timeout_s
        value = await self._state(key)
        while value != wanted:
            if time.monotonic() > deadline_s:
                raise RwsError(f"{key} is {value} after {timeout_s:g} s, expected {wanted}{remedy}")
            await asyncio.sleep(self.settings.poll_s)
            value = await self._state(key)

    async def _state(self, key: Resource, name: str = "") -> str:
        generation = await self.generation()
        path = generation.paths[key].format(name=name)
        answer = await self._request("GET", path)
        try:
            return str(generation.state(answer.json())[key])
        except (ValueError, KeyError, IndexError, TypeError):
            raise RwsError(f"GET {path}: answer without {key}: {answer.text[:80]!r}") from None

    async def _order(self, order: Order, form: Mapping[str, str], name: str = "") -> None:
        path, query = (await self.generation()).orders[order]
        await self._request("POST", path.format(name=name), query, form)

    async def _request(
        self, method: str, path: str, query: Mapping[str, str] | None = None, form: Mapping[str, str] | None = None
    ) -> httpx.Response:
        generation = await self.generation()
        headers = {**generation.headers, **({} if form is None else generation.form)}
        params = {**(query or {}), **generation.query}
        answer = await self._exchange(method, path, headers=headers, params=params, data=form, auth=self._auth)
        if answer.is_success:
            return answer
        raise RwsError(f"{method} {path}: HTTP {answer.status_code}{_reason(generation, answer)}")

    async def _exchange(self, method: str, path: str, **more: Any) -> httpx.Response:
        try:
            # httpx bounds each network operation; this bounds the whole exchange, digest round included
            async with asyncio.timeout(2.0 * self.settings.request_timeout_s):
                return await self._client.request(method, path, **more)
        except Exception as error:  # not only HTTP errors: a challenge unknown to httpx is a KeyError
            text = f"{method} {path}: {type(error).__name__} {error}".rstrip()
            raise RwsError(text + _advice(error, self.settings.url)) from None


def _advice(error: BaseException, url: str) -> str:
    """Remedy for a connection that cannot be made; empty if unknown."""
    causes: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in causes:
        causes.append(cause)
        cause = cause.__cause__ or cause.__context__
    if any(isinstance(one, ssl.SSLCertVerificationError) for one in causes):
        return (
            f"; {url} shows a certificate that is not trusted: set robot.rws.certificate to it, or robot.rws.ca to"
            " its authority's, as a PEM file"
        )
    if any(isinstance(one, ssl.SSLError) for one in causes):
        return f"; {url} speaks no TLS: a controller with RobotWare 6 (IRC5) is reached by http://"
    if url.startswith("http:") and isinstance(error, httpx.ConnectError | httpx.RemoteProtocolError):
        return "; a controller with RobotWare 7 (OmniCore) is reached by https://: see robot.rws.url"
    return ""


def _reason(generation: Generation, answer: httpx.Response) -> str:
    try:
        return f": {generation.reason(answer.json())}"
    except (ValueError, KeyError, TypeError, AttributeError):
        return ""
