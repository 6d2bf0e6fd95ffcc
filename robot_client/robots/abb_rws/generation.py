"""Common parts and differences of the generations of Robot Web Services: a generation is one object.

The controller itself shows its generation: each one refuses a request without a password in its own way.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal
from urllib.parse import urlsplit

import httpx

from robot_client.ports import DriverError

Resource = Literal["opmode", "ctrlstate", "speedratio", "ctrlexecstate", "lvalue"]
Order = Literal["motors", "to_main", "start", "stop", "signal"]
CHALLENGE = "www-authenticate"


class RwsError(DriverError):
    """The controller did not answer or refused; the text names request and reason."""


@dataclass(frozen=True, slots=True)
class Generation:
    """One generation: its password challenge, request headers, resource paths and answers.

    ``headers`` go with every request, ``form`` in addition with one that has a body, ``query`` with every address.
    ``paths`` has the resource that holds each state, ``orders`` path and query of each order; ``{name}`` in them is a
    signal's. ``state`` takes the first state out of a parsed answer, ``reason`` the words of a refusal; both may raise
    KeyError, IndexError or TypeError.
    """

    name: str
    headers: Mapping[str, str]
    form: Mapping[str, str]
    query: Mapping[str, str]
    paths: Mapping[Resource, str]
    orders: Mapping[Order, tuple[str, Mapping[str, str]]]
    answered: Callable[[httpx.Response], bool]
    state: Callable[[Any], Mapping[str, Any]]
    reason: Callable[[Any], str]


def credentials(challenge: str, url: str, user: str, password: str) -> httpx.Auth:
    """The credentials for a challenge, digest or basic; raises RwsError if the password would be sent in clear text."""
    if challenge.lower().startswith("digest"):
        return httpx.DigestAuth(user, password)
    parts = urlsplit(url)
    if parts.scheme != "https" and parts.hostname not in {"127.0.0.1", "::1", "localhost"}:
        raise RwsError(f"{url} asks for the password in the clear; set robot.rws.url to https://{parts.netloc}")
    return httpx.BasicAuth(user, password)
