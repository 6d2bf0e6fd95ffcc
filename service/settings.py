"""The service's settings: command line over environment (``TACTILE_*``) over a TOML file (``--config``)."""

import argparse
import json
import os
import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, get_args

from pydantic import (
    BeforeValidator,
    Field,
    SecretStr,
    ValidationError,
    field_serializer,
    field_validator,
    model_validator,
)
from pydantic_settings import (
    BaseSettings,
    CliApp,
    CliSettingsSource,
    InitSettingsSource,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)
from pydantic_settings import SettingsError as CliError

from service.contract import ContractError
from service.contract.refusals import nearest
from service.contract.shipped import released_models
from service.contract.text import without_secrets
from service.contract.token import check_token, is_loopback, state_folder
from service.contract.toml import read_toml
from service.contract.wire import ControllerName, Limits

HELP = "python -m service run --help"
OTHER_VARIABLES = ("TACTILE_INSERTION_", "TACTILE_REAL_DATA", "TACTILE_SCREENSHOTS", "TACTILE_TRACEBACK")
"""Prefixes of other variables: of the robot client (or Kubernetes), of tests, of every command."""


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Time limits of the stages of an attempt."""

    reference_s: float = 2.0  # from `arm` to the first pair captured after it, from `learn_open` to its answer
    decision_frames_s: float = 2.0  # from `stopped` to the last frame the networks need
    decision_s: float = 10.0  # from `stopped` to the networks' result


class _Help(argparse.RawDescriptionHelpFormatter):
    """Option help for engineers: no default where there is none, and no name of a default's function."""

    def _expand_help(self, action: argparse.Action) -> str:
        return re.sub(r" \(default(: null| factory: \w+)\)", "", super()._expand_help(action))


def _several(given: Any) -> Any:
    """Texts with commas between them, as variables have them, or a JSON list."""
    if not isinstance(given, str):
        return given
    try:
        return json.loads(given)
    except ValueError:
        return [one.strip() for one in given.split(",") if one.strip()]


Several = Annotated[tuple[str, ...], NoDecode, BeforeValidator(_several)]


class SettingsError(ContractError):
    """Settings that cannot be used; the text names the option."""


class Settings(BaseSettings):
    """Serve insertions: two cameras in, slip and corrections out, a page at /.

    Example: python -m service run --calibration cell/calibration.toml
    --camera-left http://127.0.0.1:8081/stream.mjpg
    --camera-right http://127.0.0.1:8082/stream.mjpg

    Each option may also be a variable (TACTILE_CAMERA_LEFT) or a line of a
    TOML file (camera_left = "v4l2:0" in --config FILE). The command line wins
    over the environment, the environment over the file.
    """

    model_config = SettingsConfigDict(
        env_prefix="TACTILE_",
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        cli_kebab_case=True,
        cli_hide_none_type=True,
        cli_exit_on_error=False,
    )

    models: Path = Field(
        default_factory=released_models, description="folder of ONNX files with cards; default the released"
    )
    shadow: Path | None = Field(None, description="folder with networks to run beside, and to decide once shown better")
    camera_left: str = Field(description="left finger: http://HOST:PORT/PATH (MJPEG), v4l2:N, file:PATH or push:")
    camera_right: str = Field(description="right finger, same forms")
    calibration: Path | None = Field(None, description="rectification TOML; leave out for rectified cameras")
    host: str = Field("127.0.0.1", description="address to listen on; anything but loopback needs a token")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on; 0 takes any free one and prints it")
    recordings: Path = Field(Path("recordings"), description="folder for recorded insertions")
    recordings_max_gb: float = Field(20.0, gt=0, description="oldest insertions are removed beyond this")
    controller: ControllerName = Field("belief", description="heuristic (the paper's) or belief (remembers attempts)")
    imprint_slip: bool = Field(True, description="stop for a sliding imprint, too, not for the markers' slip alone")
    frame_rate_hz: float | None = Field(None, gt=0, le=240, description="asked of V4L2 cameras; default the sensor's")
    max_dx_mm: float = Field(15.0, gt=0, le=50, description="largest correction across the gap ever sent")
    max_dtheta_deg: float = Field(15.0, gt=0, le=45, description="largest yaw correction ever sent")
    max_frame_age_ms: float = Field(500.0, gt=0, description="an older newest frame during a descent is a fault")
    client_timeout_s: float = Field(10.0, gt=0, description="a silent driving client is given up after this")
    reference_timeout_s: float = Field(
        2.0, gt=0, description="from arm to a reference (later is refused), and from learn_open to its answer"
    )
    frames_timeout_s: float = Field(2.0, gt=0, description="from stopped to the last frame that the networks need")
    decision_timeout_s: float = Field(10.0, gt=0, description="from stopped to the answer; later is no_decision")
    camera_wait_s: float = Field(10.0, ge=0, description="how long start-up waits for each camera's first frame")
    state: Path = Field(default_factory=state_folder, description="folder for the token made at the first start")
    token_drive: SecretStr | None = Field(None, description="bearer token of clients that drive (they may also watch)")
    token_watch: SecretStr | None = Field(None, description="bearer token of clients that only watch")
    token_admin: SecretStr | None = Field(None, description="for loading models, deleting recordings; default: made")
    tls_certificate: Path | None = Field(None, description="PEM certificate; serve https and wss")
    tls_key: Path | None = Field(None, description="PEM key of the certificate")
    allowed_origins: Several = Field((), description="more origins of pages in browsers, comma-separated")
    allowed_hosts: Several = Field((), description="more names of this service in requests, comma-separated")
    requests_per_s: float = Field(1000.0, ge=0, description="most requests a second of one address; 0 for any number")
    log_json: bool = Field(False, description="one JSON object a log line")

    @field_serializer("camera_left", "camera_right")
    def _shown(self, camera: str) -> str:
        return without_secrets(camera)  # recordings hold the settings

    @field_validator("token_drive", "token_watch", "token_admin")
    @classmethod
    def _secret(cls, token: SecretStr | None) -> SecretStr | None:
        if token is not None:
            check_token(token.get_secret_value())
        return token

    @field_validator("models", "recordings", "state", mode="before")
    @classmethod
    def _folder(cls, path: Any) -> Any:
        if path == "":
            raise ValueError("expected a folder, this is empty")
        return path

    @field_validator("shadow", "calibration", mode="before")
    @classmethod
    def _left_out(cls, path: Any) -> Any:
        return path or None  # a variable left empty names no file

    @field_validator("allowed_hosts")
    @classmethod
    def _names(cls, hosts: tuple[str, ...]) -> tuple[str, ...]:
        for host in hosts:
            if not re.fullmatch(r"(\*\.)?[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\]", host):
                raise ValueError(f"{host!r} is no host name; expected cell-pc.local, *.example.com or 192.168.1.20")
        return hosts

    @field_validator("allowed_origins")
    @classmethod
    def _as_browsers_write_them(cls, origins: tuple[str, ...]) -> tuple[str, ...]:
        for origin in origins:
            if not re.fullmatch(r"[a-z][a-z0-9+.-]*://([a-z0-9_.-]+|\[[0-9a-f:.]+\])(:\d+)?", origin, re.IGNORECASE):
                raise ValueError(f"{origin!r} is no origin; expected http://HOST:PORT or https://HOST, no more")
        return tuple(re.sub(r"^(http://.+):80$|^(https://.+):443$", r"\1\2", origin.lower()) for origin in origins)

    @model_validator(mode="after")
    def _safe(self) -> Self:
        if not self.is_loopback and self.token_drive is None:
            raise ValueError(f"host {self.host} is reachable from outside: set --token-drive, or listen on 127.0.0.1")
        if self.camera_left == self.camera_right and self.camera_left.startswith(("http:", "v4l2:", "/dev/")):
            raise ValueError(
                f"camera_left and camera_right are both {without_secrets(self.camera_left)}:"
                " each finger has its own camera"
            )
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key go together: give both or neither")
        tokens = [t.get_secret_value() for t in (self.token_watch, self.token_drive, self.token_admin) if t is not None]
        if len(set(tokens)) < len(tokens):
            raise ValueError("two roles have the same token: whoever may watch could drive; give each its own")
        return self

    @property
    def recordings_max_bytes(self) -> int:
        return int(self.recordings_max_gb * 1e9)

    @property
    def hosts(self) -> tuple[str, ...]:
        """All host names accepted in requests: this machine's, the listening address, and the configured ones.

        Another name is that of a page that made a browser resolve it to this address (DNS rebinding).
        """
        listens = {self.host_in_url} - {"0.0.0.0", "[::]"}  # noqa: S104
        return (*sorted({"localhost", "127.0.0.1", "[::1]", socket.gethostname()} | listens), *self.allowed_hosts)

    @property
    def host_in_url(self) -> str:
        """The listening address as URLs have it: IPv6 in brackets."""
        return f"[{self.host}]" if ":" in self.host else self.host

    @property
    def is_loopback(self) -> bool:
        return is_loopback(self.host)

    @property
    def deadlines(self) -> Deadlines:
        return Deadlines(self.reference_timeout_s, self.frames_timeout_s, self.decision_timeout_s)

    @property
    def limits(self) -> Limits:
        return Limits(
            max_dx_mm=self.max_dx_mm, max_dtheta_deg=self.max_dtheta_deg, max_frame_age_ms=self.max_frame_age_ms
        )


def read_settings(arguments: Sequence[str]) -> Settings:
    """Settings from a command line; raise SettingsError with one line that names the option, variable or file and key.

    ``--config FILE`` gives defaults from TOML with the same names (underscores for dashes).
    """
    rest, path, table = _take_config(arguments)
    _check_keys(path, table)
    kind = _with_defaults(table)
    try:
        source: CliSettingsSource[Settings] = CliSettingsSource(
            kind, cli_prog_name="tactile-insertion serve", formatter_class=_Help
        )
        return CliApp.run(kind, cli_args=rest, cli_settings_source=source)
    except CliError as error:
        unknown = re.search(r"unrecognized arguments: --(\S+)", str(error))
        hint = nearest(unknown[1].split("=")[0].replace("-", "_"), Settings.model_fields) if unknown else ""
        raise SettingsError(f"{error}{hint.replace('_', '-')} ({HELP})") from error
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0]) if first["loc"] else ""
        choices = get_args(Settings.model_fields[name].annotation) if first["type"] == "literal_error" else ()
        hint = nearest(str(first["input"]), choices) if choices else ""
        where = f"{_origin(name, rest, path, table)}: " if name else ""
        raise SettingsError(f"{where}{first['msg'].removeprefix('Value error, ')}{hint} ({HELP})") from error


def _take_config(arguments: Sequence[str]) -> tuple[list[str], str, dict[str, Any]]:
    """The other arguments, the path of ``--config`` and its table."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--config", default="")
    try:
        known, rest = parser.parse_known_args(arguments)
        return rest, known.config, read_toml(known.config) if known.config else {}
    except argparse.ArgumentError as error:
        raise SettingsError("--config needs a TOML file") from error
    except (OSError, ContractError) as error:
        raise SettingsError(f"--config: {error}") from error


def _check_keys(path: str, table: Mapping[str, Any]) -> None:
    """Raise SettingsError on a key of the file, or a variable of the environment, that is not a setting."""
    for key in table:
        if key not in Settings.model_fields:
            raise SettingsError(f"--config {path}: {key} is not used{nearest(key, Settings.model_fields)}")
    variables = [f"TACTILE_{name.upper()}" for name in Settings.model_fields]
    for name in sorted(os.environ):
        upper = name.upper()  # a variable in small letters would be a setting to some readers and none to others
        if upper.startswith("TACTILE_") and name not in variables and not upper.startswith(OTHER_VARIABLES):
            raise SettingsError(f"environment: {name} is not used{nearest(upper, variables)}")


def _origin(name: str, arguments: Sequence[str], path: str, table: Mapping[str, Any]) -> str:
    """Origin of a setting: the option, else the variable, else the file; the option if none."""
    option = "--" + name.replace("_", "-")
    if any(argument.split("=")[0] == option for argument in arguments):
        return option
    variable = f"TACTILE_{name.upper()}"
    if variable in os.environ:
        return variable
    return f"--config {path}: {name}" if name in table else option


def _with_defaults(table: dict[str, Any]) -> type[Settings]:
    """A Settings class with the given table as its lowest source."""

    class Configured(Settings):
        @classmethod
        def settings_customise_sources(  # type: ignore[override]
            cls, settings_cls: type[BaseSettings], *, init_settings: Any, env_settings: Any, **_: Any
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, env_settings, InitSettingsSource(settings_cls, table)

    return Configured if table else Settings
