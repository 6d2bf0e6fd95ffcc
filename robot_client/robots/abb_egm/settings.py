"""The EGM arm's table of the configuration: ``[robot]``."""

from typing import ClassVar, Literal

from pydantic import Field

from robot_client.ports import DeviceSettings
from robot_client.robots.abb_rws.settings import VARIABLES, RwsSettings


class Settings(DeviceSettings):
    """Our listening address, the robot to answer, and the allowed silence and delay of the stream."""

    variables: ClassVar = VARIABLES
    pauses: ClassVar = True
    device: Literal["abb_egm"] = "abb_egm"
    bind: str = "0.0.0.0"  # noqa: S104 the controller is another host; robot_host narrows who is answered
    port: int = Field(default=6510, ge=0, le=65535)
    robot_host: str | None = None
    ready_timeout_s: float = Field(default=8.0, gt=0)
    silence_s: float = Field(default=0.25, gt=0, le=30)  # harmless in position mode: targets stop with the stream
    max_age_s: float = Field(default=0.25, gt=0, le=30)
    rws: RwsSettings = RwsSettings()

    @property
    def hosts(self) -> tuple[str, ...]:
        return (self.rws.host, self.robot_host or self.rws.host)
