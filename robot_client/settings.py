"""The client's configuration: one TOML file, every key checked, an unknown one refused with the nearest allowed."""

import difflib
import json
import os
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError

from robot_client import devices
from robot_client.devices import GRIPPERS, ROBOTS
from robot_client.insertion.geometry import CellFrame
from robot_client.insertion.lease import Lease
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.insertion.pace import Pace
from robot_client.insertion.state import Timeouts
from robot_client.ports import Arm, DeviceSettings, Gripper
from robot_client.session.cycle import CycleSettings
from robot_client.session.service_link import ServiceSettings
from robot_client.session.travel import Errands
from service.contract.frames import Contract, ContractError
from service.contract.refusals import describe, nearest
from service.contract.token import is_loopback
from service.contract.toml import read_toml
from service.contract.wire_parts import DEPTH_TOLERANCE_MM

REGISTRIES = {"robot": ROBOTS, "gripper": GRIPPERS}
DEFAULT_DEVICES = {"robot": "abb_egm", "gripper": "wsg50"}
VARIABLES = "TACTILE_INSERTION_"
Positive = Annotated[float, Field(gt=0)]
Table = TypeVar("Table", bound=BaseModel)


class SettingsError(ContractError):
    """The configuration is wrong; the text names file, key and expectation."""


class Task(Contract):
    """The insertion itself. Heights are those of the TCP in the work-object frame."""

    approach_z_mm: float = 35.0  # 30 mm above the object's bottom, which is approach_clearance_mm above the blocks
    approach_clearance_mm: Positive = 5.0
    approach_y_mm: float = 0.0
    gap_width_mm: float = Field(default=56.0, gt=0, le=1000)
    tops_level_mm: float | None = Field(
        default=None, ge=0, le=10
    )  # how level the tops on both sides are; None: unknown
    neighbours_stay: bool = False  # no press pushes aside what stands beside the gap; False: unknown, or it may
    expected_depth_mm: float = Field(default=25.0, gt=0, le=1000)
    depth_tolerance_mm: float = Field(default=DEPTH_TOLERANCE_MM, gt=0, le=DEPTH_TOLERANCE_MM)
    creep_allowance_mm: float = Field(default=0.0, ge=0, le=50)  # deeper for an object pushed up in the hand: if free
    max_no_decisions: int = Field(default=2, ge=0, le=15)
    grip_n: float | None = Field(default=None, gt=0, le=1000)  # gripping force; None: not measured
    shear_reach_mm: float | None = Field(default=None, gt=0, le=100)  # shear of the gel at which it slides
    object: str = Field(default="", max_length=128)  # held object: for the record only

    @property
    def grasp_height_mm(self) -> float | None:
        """The TCP's height when the object touches the blocks' tops; None where the approach is too low for it."""
        height_mm = self.approach_z_mm - self.approach_clearance_mm
        return height_mm if height_mm > 0 else None


class Settings(Contract):
    """The whole configuration. ``robot`` and ``gripper`` hold the settings of the devices that they name."""

    robot: DeviceSettings = Field(default_factory=lambda: _device("robot", {}))
    gripper: DeviceSettings = Field(default_factory=lambda: _device("gripper", {}))
    service: ServiceSettings = ServiceSettings()
    work_object: CellFrame = CellFrame()
    limits: Limits = Limits()
    ramps: Ramps = Ramps()
    timeouts: Timeouts = Timeouts()
    lease: Lease = Lease()
    pace: Pace = Pace()
    task: Task = Task()
    cycle: CycleSettings | None = None
    commissioning: Path | None = None  # the record of `commission`, required for a live insertion
    simulated: bool = False  # the devices are those of a simulated cell: no warning of a moving robot

    def tables(self) -> dict[str, Any]:
        """The tables of its file, without defaults, and without what may come from the environment: the password."""
        tables = self.model_dump(mode="json", exclude_unset=True, exclude={*REGISTRIES})
        for name in REGISTRIES:
            device: DeviceSettings = getattr(self, name)
            tables[name] = {"device": device.device, **device.model_dump(mode="json", exclude_unset=True)}
            for *above, key in device.variables.values():
                reduce(lambda table, part: table.get(part, {}), above, tables[name]).pop(key, None)
        return tables

    def make_arm(self) -> Arm:
        """The arm behind its port; nothing is connected yet."""
        return devices.make_arm(self.robot, self.limits, self.ramps, self.work_object)

    def make_gripper(self) -> Gripper:
        """The gripper behind its port; nothing is connected yet."""
        return devices.make_gripper(self.gripper)

    @property
    def errands(self) -> Errands:
        """The errands on the configured devices."""
        return Errands(
            make_arm=self.make_arm,
            make_gripper=self.make_gripper,
            limits=self.limits,
            ramps=self.ramps,
            motion_s=self.timeouts.motion_s,
            clear_mm=self.task.approach_z_mm,
        )


def load_settings(path: Path | None, overrides: dict[str, Any] | None = None) -> Settings:
    """Settings of a TOML file (None: defaults) with the tables of ``overrides`` on top; raises SettingsError.

    An environment variable that replaces a key of a device (the RWS password) takes precedence over the file.
    """
    source = str(path or "configuration")
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = read_toml(path)
        except (OSError, ContractError) as error:
            raise SettingsError(f"cannot read configuration {path}: {error}") from None
    data = _merged(data, overrides or {})
    chosen = {key: _device(key, data.pop(key, {}), source) for key in REGISTRIES}
    known = [name for device in chosen.values() for name in device.variables]
    for name in os.environ:
        upper = name.upper()
        ours = upper.startswith(VARIABLES) or difflib.get_close_matches(upper, known, 1, 0.8)
        if ours and name not in known:
            raise SettingsError(f"environment: {name} is not used{nearest(upper, known)}")
    names = {key: {"device": device.device} for key, device in chosen.items()}
    settings = _table(Settings, {**data, **names}, source)
    if settings.simulated:
        _check_simulated(chosen, source)
    return settings.model_copy(update=chosen)


def _check_simulated(chosen: dict[str, DeviceSettings], source: str) -> None:
    """Raise SettingsError for a device elsewhere: a real arm would move without a commissioning and a warning."""
    for key, device in chosen.items():
        if device.hosts is None:
            raise SettingsError(
                f"{source}: simulated = true, but Settings of {device.device!r} have no hosts: nothing shows that the"
                f" {key} is on this machine; remove the line for a real one"
            )
        for host in device.hosts:
            if not is_loopback(host):
                raise SettingsError(
                    f"{source}: simulated = true, but the {key} is at {host}: a simulated cell is on this machine;"
                    " remove the line for a real one"
                )


def _merged(data: dict[str, Any], overrides: dict[str, Any]) -> dict[str, Any]:
    """``data`` with the overrides that are not None; a value in place of a table is left for the validation."""
    merged = dict(data)
    for key, value in overrides.items():
        if isinstance(value, dict):
            below = data.get(key, {})
            value = (_merged(below, value) or None) if isinstance(below, dict) else below  # noqa: PLW2901
        if value is not None:
            merged[key] = value
    return merged


def _device(key: str, data: Any, source: str = "") -> DeviceSettings:
    """The table of one device, with the variables that replace its keys."""
    name = data.get("device", DEFAULT_DEVICES[key]) if isinstance(data, dict) else DEFAULT_DEVICES[key]
    try:
        model = devices.settings_of(REGISTRIES[key], name)
    except ValueError as error:
        raise SettingsError(f"{source}: {key}.{error}") from None
    for variable, way in model.variables.items():
        value: Any = os.environ.get(variable)
        if value and isinstance(data, dict):
            for part in reversed(way):
                value = {part: value}
            data = _merged(data, value)
    return _table(model, data, source, key)


def _table(model: type[Table], data: Any, source: str, key: str = "") -> Table:
    """``data`` as ``model``; raises SettingsError with file and key, and for an unknown key the nearest one."""
    try:
        return model.model_validate_json(json.dumps(data))
    except ValidationError as error:
        raise SettingsError(f"{source}: {describe(error, model, key, secret=True)}") from None
    except (ValueError, TypeError) as error:
        raise SettingsError(f"{source}: {error}") from None
