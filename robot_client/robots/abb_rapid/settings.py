"""The RAPID socket arm's table of the configuration: ``[robot]``."""

from typing import ClassVar, Literal

from pydantic import Field

from robot_client.ports import DeviceSettings
from robot_client.robots.abb_rws.settings import VARIABLES, RwsSettings


class Settings(DeviceSettings):
    """Addresses of TactileMotion.mod and TactileGuard.mod."""

    variables: ClassVar = VARIABLES
    device: Literal["abb_rapid"] = "abb_rapid"
    host: str = "192.168.125.1"
    motion_port: int = Field(default=5010, ge=0, le=65535)
    guard_port: int = Field(default=5011, ge=0, le=65535)
    connect_timeout_s: float = Field(default=5.0, gt=0)
    poll_s: float = Field(default=0.02, gt=0, le=0.05)  # half of silenceLimit of TactileGuard.mod
    silence_s: float = Field(default=0.5, gt=0, le=30)
    rws: RwsSettings = RwsSettings()

    @property
    def hosts(self) -> tuple[str, ...]:
        return (self.rws.host, self.host)
