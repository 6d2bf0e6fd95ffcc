"""Robot Web Services in the configuration: ``[robot.rws]``."""

from typing import Literal
from urllib.parse import urlsplit

import httpx
from pydantic import Field, SecretStr, field_validator

from service.contract.frames import Contract

VARIABLES: dict[str, tuple[str, ...]] = {"TACTILE_INSERTION_RWS_PASSWORD": ("rws", "password")}


class RwsSettings(Contract):
    """Where the controller is and how long it may take. User and password are ABB's factory defaults."""

    url: str = Field(default="http://192.168.125.1", pattern=r"^https?://[^/\s]+/?$")
    user: str = "Default User"
    password: SecretStr = SecretStr("robotics")
    request_timeout_s: float = Field(default=1.0, gt=0)
    motors_timeout_s: float = Field(default=5.0, gt=0)
    start_timeout_s: float = Field(default=5.0, gt=0)
    stop_timeout_s: float = Field(default=3.0, gt=0)
    poll_s: float = Field(default=0.05, gt=0)
    switch_motors_on: bool = True
    cycle: Literal["asis", "once", "forever"] = "asis"

    @field_validator("url")
    @classmethod
    def _reachable(cls, url: str) -> str:
        """Refuse what cannot be an address here: httpx would raise only when it is used."""
        try:
            httpx.URL(url).copy_with(port=urlsplit(url).port)
        except (ValueError, httpx.InvalidURL) as error:
            raise ValueError(f"{url!r} is no address: {error}") from None
        return url
