"""The WSG-50's table of the configuration: ``[gripper]``."""

from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from robot_client.ports import DeviceSettings


class Settings(DeviceSettings):
    """Address of the gripper and its grasp. Ranges are checked against the gripper's own limits (0x53)."""

    grip_key: ClassVar[str] = "force_limit_n"
    device: Literal["wsg50"] = "wsg50"
    host: str = "192.168.1.20"
    port: int = Field(default=1000, ge=0, le=65535)
    grasp_width_mm: float = 40.0
    grasp_speed_mm_s: float = 30.0
    force_limit_n: float = Field(default=40.0, gt=0)
    reply_timeout_s: float = Field(default=1.0, gt=0)
    motion_timeout_s: float = Field(default=10.0, gt=0)
    update_period_ms: int = Field(default=20, ge=10, le=200)
    silence_s: float = Field(default=0.5, gt=0, le=30)

    @model_validator(mode="after")
    def _outlasts_a_lost_update(self) -> Self:
        least_s = 2 * self.update_period_ms / 1000
        if not self.silence_s >= least_s:
            why = f"two update periods, {least_s:g} s: update_period_ms = {self.update_period_ms}"
            raise ValueError(f"silence_s = {self.silence_s:g}, expected at least {why}")
        return self

    @property
    def hosts(self) -> tuple[str, ...]:
        return (self.host,)

    @property
    def address(self) -> str:
        """HOST:PORT."""
        return f"{self.host}:{self.port}"
