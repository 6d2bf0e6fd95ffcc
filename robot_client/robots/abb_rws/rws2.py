"""Robot Web Services 2.0: OmniCore with RobotWare 7. Based on published user code; tested only on an emulator.

Sources: ros-industrial/abb_librws (``v2_0``) for paths, versions of media and mastership; recorded answers of
controllers with RobotWare 7 that users have published for the form of the JSON.
"""

from typing import Any

import httpx

from robot_client.robots.abb_rws.generation import CHALLENGE, Generation

_EXECUTION = "/rw/rapid/execution"
MEDIA = "application/hal+json;v=2.0"


def _answered(refusal: httpx.Response) -> bool:
    basic = refusal.headers.get(CHALLENGE, "").lower().startswith("basic")
    return basic or (CHALLENGE in refusal.headers and "v=2" in refusal.headers.get("content-type", ""))


def _state(body: Any) -> Any:
    rows = body["state"] if "state" in body else body["_embedded"]["resources"]  # the latter for lists and signals
    return rows[0]


def _reason(body: Any) -> str:
    status = body["status"]
    return str(status.get("msg", status.get("code")))


RWS2 = Generation(
    name="Robot Web Services 2.0 (RobotWare 7, OmniCore)",
    headers={"Accept": MEDIA},
    form={"Content-Type": "application/x-www-form-urlencoded;v=2.0"},
    query={},
    paths={
        "opmode": "/rw/panel/opmode",
        "ctrlstate": "/rw/panel/ctrl-state",
        "speedratio": "/rw/panel/speedratio",
        "ctrlexecstate": _EXECUTION,
        "lvalue": "/rw/iosystem/signals/{name}",
    },
    orders={
        "motors": ("/rw/panel/ctrl-state", {}),
        "to_main": (f"{_EXECUTION}/resetpp", {"mastership": "implicit"}),  # held for this request, then released
        "start": (f"{_EXECUTION}/start", {"mastership": "implicit"}),
        "stop": (f"{_EXECUTION}/stop", {}),
        "signal": ("/rw/iosystem/signals/{name}/set-value", {}),
    },
    answered=_answered,
    state=_state,
    reason=_reason,
)
