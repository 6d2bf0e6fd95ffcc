"""Robot Web Services in the configuration: ``[robot.rws]``."""

import ssl
from pathlib import Path
from urllib.parse import urlsplit

import httpx
from pydantic import Field, SecretStr, field_validator

from service.contract.frames import Contract

VARIABLES: dict[str, tuple[str, ...]] = {"TACTILE_INSERTION_RWS_PASSWORD": ("rws", "password")}


class RwsSettings(Contract):
    """Address and time limits of the controller. User and password are ABB's factory defaults.

    A controller at https:// is trusted by its ``certificate`` (a PEM file: exactly this certificate, whatever its
    name), by that of its authority (``ca``), or by the authorities known to this machine.
    """

    url: str = Field(default="http://192.168.125.1", pattern=r"^https?://[^/\s]+/?$")
    user: str = "Default User"
    password: SecretStr = SecretStr("robotics")
    certificate: Path | None = None
    ca: Path | None = None
    request_timeout_s: float = Field(default=1.0, gt=0)
    motors_timeout_s: float = Field(default=5.0, gt=0)
    start_timeout_s: float = Field(default=5.0, gt=0)
    stop_timeout_s: float = Field(default=3.0, gt=0)
    poll_s: float = Field(default=0.05, gt=0)
    switch_motors_on: bool = True

    @field_validator("url")
    @classmethod
    def _reachable(cls, url: str) -> str:
        """Refuse an invalid address here: httpx would raise only on use, and send a password in it in the clear."""
        if "@" in url:
            raise ValueError("an address without user and password: these are robot.rws.user and robot.rws.password")
        try:
            httpx.URL(url).copy_with(port=urlsplit(url).port)
        except (ValueError, httpx.InvalidURL) as error:
            raise ValueError(f"{url!r} is no address: {error}") from None
        return url

    @field_validator("certificate", "ca")
    @classmethod
    def _readable(cls, path: Path | None) -> Path | None:
        if path is not None:
            try:
                ssl.create_default_context(cafile=path)
            except OSError as error:  # of which SSLError is one
                raise ValueError(f"{path}: expected a certificate in PEM ({error.strerror or error})") from None
        return path

    @property
    def host(self) -> str:
        """The controller's name or address in ``url``."""
        return urlsplit(self.url).hostname or ""

    @property
    def trusted(self) -> ssl.SSLContext:
        """The TLS context with the trusted certificates of the controller."""
        context = ssl.create_default_context(cafile=self.certificate or self.ca)
        if self.certificate is not None:
            context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # it need not be an authority's
            context.check_hostname = False
        return context
