"""The supported arms and grippers: one line per device, its module imported when the device is chosen.

The module of a device has ``Settings``, its table of the configuration, and ``make``, which returns the device behind
its port without connecting it:

- an arm: ``make(settings, limits, ramps, frame) -> Arm``,
- a gripper: ``make(settings) -> Gripper``.

A name with a dot is a user's own module, anywhere on Python's path.
"""

from importlib import import_module
from types import ModuleType
from typing import Any

from robot_client.insertion.geometry import CellFrame
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.ports import Arm, DeviceSettings, Gripper
from service.contract.refusals import nearest

ROBOTS = {
    "abb_egm": "robot_client.robots.abb_egm.driver",
    "abb_rapid": "robot_client.robots.abb_rapid.driver",
    "dry_run": "robot_client.robots.dry_run.driver",
}
GRIPPERS = {"wsg50": "robot_client.grippers.wsg50.driver", "dry_run": "robot_client.grippers.dry_run.driver"}


def settings_of(registry: dict[str, str], name: object) -> type[DeviceSettings]:
    """The settings of a registered device; raises ValueError for an unknown name, and a module that is no device."""
    if not isinstance(name, str) or (name not in registry and "." not in name):
        own = " (a module of your own is named with a dot)"
        raise ValueError(f"device: {name!r} is unknown{nearest(str(name), registry)}{own}")
    try:
        module = _module(registry, name)
        settings: type[DeviceSettings] = module.Settings
        _ = module.make
    except (ImportError, AttributeError, SyntaxError) as error:
        raise ValueError(f"device: {name!r} is no module with Settings and make: {error}") from error
    fits = isinstance(settings, type) and issubclass(settings, DeviceSettings)
    if not fits:
        raise ValueError(f"device: Settings of {name!r} is {settings!r}, expected a class of DeviceSettings")
    return settings


def _module(registry: dict[str, str], name: str) -> ModuleType:
    return import_module(registry.get(name, name))


def make_arm(settings: DeviceSettings, limits: Limits, ramps: Ramps, frame: CellFrame) -> Arm:
    """The arm for ``settings``, behind its port, not connected yet; raises ValueError for one that lacks an order."""
    arm: Arm = _made(ROBOTS, settings, limits, ramps, frame)
    return arm


def make_gripper(settings: DeviceSettings) -> Gripper:
    """The gripper for ``settings``, behind its port, not connected yet; raises ValueError as above."""
    gripper: Gripper = _made(GRIPPERS, settings)
    return gripper


def _made(registry: dict[str, str], settings: DeviceSettings, *more: object) -> Any:
    make = _module(registry, settings.device).make
    try:
        return make(settings, *more)
    except TypeError as error:
        raise ValueError(f"device: {settings.device!r} cannot be made: {error}") from error
