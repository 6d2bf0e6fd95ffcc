"""Pictures of a probe from the service's recording of it: both gels open, and pressed with their markers' motion."""

import asyncio
import html
import ssl
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from typing import Any

import httpx

from robot_client.ports import DriverError
from robot_client.session.service_link import ServiceSettings
from service.contract.frames import FINGERS

WAIT_S, LOOK_S = 15.0, 0.2  # until the service has closed a recording
LATE_S = 0.2  # the last pictures of both fingers are of one standstill
GAIN = 4.0  # arrows are longer than the motion, as on the service's page
OUTSIDE, STICKS, SLIPS = range(3)
HEAD = '<marker id="head" refX="4" refY="2" markerHeight="4" orient="auto"><polygon points="0 0 4 2 0 4"/></marker>'
COLOURS = {OUTSIDE: "#8fa0b0", STICKS: "#35c6c0", SLIPS: "#ff5b45"}
Panel = tuple[str, Mapping[str, Any]]
_ANSWERS = (KeyError, IndexError, TypeError, ValueError)  # of a service of another version


async def picture_of(service: ServiceSettings, insertion_id: str, caption: str) -> str:
    """The picture of a probe that has ended, as SVG; raises DriverError if its recording does not show it."""
    token = service.token()
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    address = httpx.URL(service.url)  # of a WebSocket beside the recordings
    base = address.copy_with(scheme=address.scheme.replace("ws", "http")).join(".")
    trusted = ssl.create_default_context()  # as the WebSocket's: the system's authorities and SSL_CERT_FILE
    asking = httpx.AsyncClient(base_url=base, headers=headers, timeout=WAIT_S, trust_env=False, verify=trusted)
    try:
        async with asking as http:
            return svg(caption, [panel async for panel in _panels(http, insertion_id)])
    except DriverError:
        raise
    except httpx.HTTPError as error:
        why = f"{type(error).__name__} {error}"
    except _ANSWERS as error:
        why = f"answers without {error}"
    raise DriverError(f"service: no picture of {insertion_id}: {why}")


async def _panels(http: httpx.AsyncClient, insertion_id: str) -> AsyncIterator[Panel]:
    name = await _recorded(http, insertion_id)
    curves = await _got(http, f"recordings/{name}/timeline")
    shown = [moment for moment in curves["moments"] if all(moment[finger] for finger in FINGERS)]
    if not shown:
        raise DriverError(f"service: no picture of {insertion_id}: at no moment had both fingers one")
    pressed = shown[-1]  # of the standstill: nothing is judged after it
    if curves["moments"][-1]["t"] - pressed["t"] > LATE_S:
        raise DriverError(f"service: no picture of {insertion_id}: one finger had none at its end")
    for finger in FINGERS:
        for state, at_ns in (("open", curves["open"][finger]), ("pressed", pressed[finger])):
            yield f"{finger}, {state}", await _got(http, f"recordings/{name}/moments/{finger}/{at_ns}")


async def _recorded(http: httpx.AsyncClient, insertion_id: str) -> str:
    """The name of its recording, once that is closed."""
    until_s = time.monotonic() + WAIT_S
    while True:
        listed = (await _got(http, "recordings", insertion_id=insertion_id))["recordings"]
        if listed:
            return str(listed[0]["name"])
        if time.monotonic() > until_s:
            why = f"nothing of it was recorded within {WAIT_S:g} s; GET /readyz of the service says why"
            raise DriverError(f"service: no picture of {insertion_id}: {why}")
        await asyncio.sleep(LOOK_S)


async def _got(http: httpx.AsyncClient, path: str, **asked: str) -> Mapping[str, Any]:
    answer = await http.get(path, params=asked)
    answer.raise_for_status()
    content: Mapping[str, Any] = answer.json()
    return content


def svg(caption: str, panels: Sequence[Panel]) -> str:
    """The panels side by side, each a grey picture with an arrow for every marker that was seen."""
    width, height = (max(int(content[side]) for _, content in panels) for side in ("width", "height"))
    view = f'viewBox="0 -40 {width * len(panels)} {height + 40}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {view} font-family="sans-serif" font-size="14">{HEAD}',
        f'<text y="-24">{html.escape(caption)} (arrows x {GAIN:g}; square: slips)</text>',
    ]
    for number, (name, content) in enumerate(panels):
        lines += [
            f'<g transform="translate({number * width} 0)"><text y="-6">{html.escape(name)}</text>',
            f'<image width="{width}" height="{height}" href="data:image/jpeg;base64,{html.escape(content["jpeg"])}"/>',
            *_arrows(content),
            "</g>",
        ]
    return "\n".join([*lines, "</svg>", ""])


def _arrows(content: Mapping[str, Any]) -> Iterator[str]:
    rest, moved = ([*zip(*[iter(map(float, content[key]))] * 2, strict=True)] for key in ("rest", "moved"))
    for (u, v), (du, dv), kind in zip(rest, moved, content["kinds"], strict=True):
        if kind in COLOURS:
            spot = "m-2 -2h4v4h-4zm2 2" if kind == SLIPS else ""
            way = f"M{u:.1f} {v:.1f}{spot}l{GAIN * du:.1f} {GAIN * dv:.1f}"
            yield f'<path d="{way}" stroke="{COLOURS[kind]}" fill="none" marker-end="url(#head)"/>'
