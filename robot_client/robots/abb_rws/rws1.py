"""Robot Web Services 1.0: IRC5 with RobotWare 6 (3HAC050973-001)."""

from typing import Any

import httpx

from robot_client.robots.abb_rws.generation import CHALLENGE, Generation

_EXECUTION = "/rw/rapid/execution"


def _answered(refusal: httpx.Response) -> bool:
    return refusal.headers.get(CHALLENGE, "").lower().startswith("digest") and "v=2" not in _media(refusal)


def _media(answer: httpx.Response) -> str:
    return str(answer.headers.get("content-type", ""))


def _state(body: Any) -> Any:
    return body["_embedded"]["_state"][0]


def _reason(body: Any) -> str:
    status = body["_embedded"]["status"]
    return str(status.get("msg", status.get("code")))


RWS1 = Generation(
    name="Robot Web Services 1.0 (RobotWare 6, IRC5)",
    headers={},
    form={},
    query={"json": "1"},
    paths={
        "opmode": "/rw/panel/opmode",
        "ctrlstate": "/rw/panel/ctrlstate",
        "speedratio": "/rw/panel/speedratio",
        "ctrlexecstate": _EXECUTION,
        "lvalue": "/rw/iosystem/signals/{name}",
    },
    orders={
        "motors": ("/rw/panel/ctrlstate", {"action": "setctrlstate"}),
        "to_main": (_EXECUTION, {"action": "resetpp"}),
        "start": (_EXECUTION, {"action": "start"}),
        "stop": (_EXECUTION, {"action": "stop"}),
        "signal": ("/rw/iosystem/signals/{name}", {"action": "set"}),
    },
    answered=_answered,
    state=_state,
    reason=_reason,
)
