"""Robot Web Services 1.0 of an IRC5 (RobotWare 6): state, motors, program start, and the backup stop.

Digest access, one session (cookie ABBCX kept), every request bounded in time. A 204 for stop does not mean stopped:
the execution state is polled until the controller reports it, and the answer names the last report.
"""

import asyncio
import contextlib
import time
from collections.abc import Mapping
from typing import Any

import httpx

from robot_client.ports import DriverError, Finding
from robot_client.robots.abb_rws.settings import RwsSettings
from service.contract.frames import Contract

_JSON = {"json": "1"}
_START = {
    "regain": "continue",
    "execmode": "continue",
    "condition": "none",
    "stopatbp": "disabled",
    "alltaskbytsp": "true",
}


class RwsError(DriverError):
    """The controller did not answer or refused; the text names request and reason."""


class ControllerStatus(Contract):
    """State of the controller."""

    operating_mode: str
    controller: str
    execution: str
    speed_ratio: str


class RwsClient:
    """One controller; make it inside the event loop that uses it."""

    def __init__(self, settings: RwsSettings) -> None:
        self.settings = settings
        self.started = False
        self._client = httpx.AsyncClient(
            base_url=settings.url,
            auth=httpx.DigestAuth(settings.user, settings.password.get_secret_value()),
            timeout=settings.request_timeout_s,
            trust_env=False,
        )

    async def close(self) -> None:
        """Give the session back (the controller has few) and close the connection."""
        with contextlib.suppress(RwsError):  # a lost controller ends the session by itself
            await self._request("GET", "/logout")
        await self._client.aclose()

    async def status(self) -> ControllerStatus:
        """Mode, state, execution and speed ratio; raises RwsError. Moves nothing."""
        return ControllerStatus(
            operating_mode=await self._state("/rw/panel/opmode", "opmode"),
            controller=await self._state("/rw/panel/ctrlstate", "ctrlstate"),
            execution=await self.execution(),
            speed_ratio=await self._state("/rw/panel/speedratio", "speedratio"),
        )

    async def findings(self) -> list[Finding]:
        """Whether the controller would let us start its program; raises RwsError. Moves nothing."""
        status = await self.status()
        motors = status.controller == "motoron" or (status.controller == "motoroff" and self.settings.switch_motors_on)
        return [
            Finding(status.operating_mode == "AUTO", f"operating mode {status.operating_mode} (expected AUTO)"),
            Finding(motors, f"controller {status.controller}"),
            Finding(status.execution == "stopped", f"RAPID {status.execution} (expected stopped)"),
            Finding(True, f"speed ratio {status.speed_ratio} %"),
        ]

    async def execution(self) -> str:
        """``running`` or ``stopped``."""
        return await self._state("/rw/rapid/execution", "ctrlexecstate")

    async def start_program(self) -> None:
        """Motors on and RAPID running; raises RwsError if the controller is not fit for it or does not follow."""
        status = await self.status()
        if status.operating_mode != "AUTO":
            raise RwsError(f"operating mode is {status.operating_mode}, expected AUTO; turn the key switch")
        if status.controller != "motoron":
            if status.controller != "motoroff" or not self.settings.switch_motors_on:
                raise RwsError(f"controller state is {status.controller}, expected motoron; release the stop by hand")
            await self._post("/rw/panel/ctrlstate", "setctrlstate", {"ctrl-state": "motoron"})
            await self._until("/rw/panel/ctrlstate", "ctrlstate", "motoron", self.settings.motors_timeout_s)
        if status.execution == "running":
            raise RwsError("the RAPID program runs already; stop it, so that guidance starts from a known state")
        self.started = True  # from here on the program is ours to stop, whatever the answer
        await self._post("/rw/rapid/execution", "start", {**_START, "cycle": self.settings.cycle})
        await self._until("/rw/rapid/execution", "ctrlexecstate", "running", self.settings.start_timeout_s)

    async def stop_program(self) -> str:
        """Ask for a stop and poll until the controller reports it; never raises, returns in words how it ended."""
        deadline_s = time.monotonic() + self.settings.stop_timeout_s
        asked, last = False, "no answer"
        while time.monotonic() < deadline_s:
            try:
                if not asked:
                    await self._post("/rw/rapid/execution", "stop", {"stopmode": "stop"})
                    asked = True
                last = await self.execution()
                if last == "stopped":
                    return "controller confirms: program stopped"
            except RwsError as error:
                last, asked = str(error), False
            await asyncio.sleep(self.settings.poll_s)
        return f"STOP NOT CONFIRMED by the controller ({last}): use the stop button"

    async def read_signal(self, name: str) -> bool:
        """Whether a digital signal of the controller is on; raises RwsError."""
        return float(await self._state(f"/rw/iosystem/signals/{name}", "lvalue")) != 0.0

    async def write_signal(self, name: str, *, on: bool) -> None:
        """Switch a digital output of the controller, whose access level must allow it; raises RwsError."""
        await self._post(f"/rw/iosystem/signals/{name}", "set", {"lvalue": "1" if on else "0"})

    # ---- requests -------------------------------------------------------------------------------------------------

    async def _until(self, path: str, key: str, wanted: str, timeout_s: float) -> None:
        deadline_s = time.monotonic() + timeout_s
        value = await self._state(path, key)
        while value != wanted:
            if time.monotonic() > deadline_s:
                raise RwsError(f"{key} is {value} after {timeout_s:g} s, expected {wanted}")
            await asyncio.sleep(self.settings.poll_s)
            value = await self._state(path, key)

    async def _state(self, path: str, key: str) -> str:
        answer = await self._request("GET", path)
        try:
            return str(answer.json()["_embedded"]["_state"][0][key])
        except (ValueError, KeyError, IndexError, TypeError):
            raise RwsError(f"GET {path}: answer without {key}: {answer.text[:80]!r}") from None

    async def _post(self, path: str, action: str, form: Mapping[str, str]) -> None:
        await self._request("POST", path, {"action": action}, form)

    async def _request(
        self, method: str, path: str, query: Mapping[str, str] | None = None, form: Mapping[str, str] | None = None
    ) -> httpx.Response:
        params = {**(query or {}), **_JSON}
        try:
            bounded = self._client.request(method, path, params=params, data=form)
            # httpx bounds each network operation; this bounds the whole exchange, digest round included
            answer = await asyncio.wait_for(bounded, 2.0 * self.settings.request_timeout_s)
        except Exception as error:  # not HTTP errors alone: a challenge that httpx does not know is a KeyError
            raise RwsError(f"{method} {path}: {type(error).__name__} {error}".rstrip()) from None
        if answer.is_success:
            return answer
        raise RwsError(f"{method} {path}: HTTP {answer.status_code}{_reason(answer)}")


def _reason(answer: httpx.Response) -> str:
    try:
        status: dict[str, Any] = answer.json()["_embedded"]["status"]
        return f": {status.get('msg', status.get('code'))}"
    except (ValueError, KeyError, TypeError):
        return ""
