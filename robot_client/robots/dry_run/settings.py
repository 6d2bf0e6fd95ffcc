"""The rehearsal arm's table of the configuration: ``[robot]``."""

from typing import Literal

from robot_client.insertion.geometry import WorkPose
from robot_client.ports import DeviceSettings


class Settings(DeviceSettings):
    """Where the TCP stands at the start."""

    device: Literal["dry_run"] = "dry_run"
    start: WorkPose = WorkPose(x_mm=0.0, y_mm=0.0, z_mm=75.0, yaw_deg=0.0)
