"""The arms and grippers that this client drives: one line a device, its package imported when the device is chosen.

A device's package has two modules: ``settings`` with ``Settings``, its table of the configuration, and ``driver`` with
``make``, which returns the device behind its port without connecting it:

- an arm: ``make(settings, limits, ramps, frame) -> Arm``,
- a gripper: ``make(settings) -> Gripper``.
"""

import difflib
from collections.abc import Iterable
from importlib import import_module

from robot_client.insertion.geometry import CellFrame
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.ports import Arm, DeviceSettings, Gripper

ROBOTS = {
    "abb_egm": "robot_client.robots.abb_egm",
    "abb_rapid": "robot_client.robots.abb_rapid",
    "dry_run": "robot_client.robots.dry_run",
}
GRIPPERS = {
    "wsg50": "robot_client.grippers.wsg50",
    "dry_run": "robot_client.grippers.dry_run",
}


def nearest(name: str, allowed: Iterable[str]) -> str:
    """The end of a refusal of ``name``: the nearest allowed name, or all of them where none is near."""
    allowed = sorted(allowed)
    near = difflib.get_close_matches(name, allowed, 1)
    return f"nearest allowed: {near[0]}" if near else f"allowed: {', '.join(allowed)}"


def settings_of(registry: dict[str, str], name: object) -> type[DeviceSettings]:
    """The settings of a registered device; raises ValueError for an unknown name."""
    if not isinstance(name, str) or name not in registry:
        raise ValueError(f"device: {name!r} is unknown; {nearest(str(name), registry)}")
    settings: type[DeviceSettings] = import_module(f"{registry[name]}.settings").Settings
    return settings


def make_arm(settings: DeviceSettings, limits: Limits, ramps: Ramps, frame: CellFrame) -> Arm:
    """The arm that ``settings`` belong to, behind its port; nothing is connected yet."""
    arm: Arm = import_module(f"{ROBOTS[settings.device]}.driver").make(settings, limits, ramps, frame)
    return arm


def make_gripper(settings: DeviceSettings) -> Gripper:
    """The gripper that ``settings`` belong to, behind its port; nothing is connected yet."""
    gripper: Gripper = import_module(f"{GRIPPERS[settings.device]}.driver").make(settings)
    return gripper
