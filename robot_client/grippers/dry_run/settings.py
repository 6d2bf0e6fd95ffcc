"""The rehearsal gripper's table of the configuration: ``[gripper]``."""

from typing import Literal

from robot_client.ports import DeviceSettings


class Settings(DeviceSettings):
    """The width that it reports, in mm."""

    device: Literal["dry_run"] = "dry_run"
    width_mm: float = 50.0
