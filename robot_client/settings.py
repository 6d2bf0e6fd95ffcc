"""The client's configuration: one TOML file, every key checked, unknown keys refused with their name."""

import json
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, SecretStr, ValidationError

from robot_client.grippers.wsg50.driver import WsgSettings
from robot_client.insertion.geometry import IDENTITY, TOOL_DOWN, CellFrame, Quaternion, Vector, normalised
from robot_client.insertion.limits import Limits
from robot_client.insertion.motion import Ramps
from robot_client.insertion.state import Timeouts
from robot_client.robots.abb_egm.driver import EgmSettings
from robot_client.robots.abb_rapid.driver import SocketSettings
from robot_client.robots.abb_rws.client import RwsSettings
from robot_client.session.service_link import ServiceSettings
from service.contract.frames import Contract, ContractError, first_error
from service.contract.toml import read_toml

PASSWORD_VARIABLE = "TACTILE_INSERTION_RWS_PASSWORD"  # noqa: S105 the variable's name, not a password
Positive = Annotated[float, Field(gt=0)]


class SettingsError(ContractError):
    """The configuration is wrong; the text names file, key and what was expected."""


class WorkObject(Contract):
    """The gap's frame in the frame of the controller's poses, and the tool at yaw 0; quaternions w, x, y, z."""

    origin_mm: Vector = (0.0, 0.0, 0.0)
    rotation: Quaternion = IDENTITY
    tool: Quaternion = TOOL_DOWN

    def frame(self) -> CellFrame:
        """The conversion that the driver uses; raises ValueError for a quaternion without direction."""
        return CellFrame(self.origin_mm, normalised(self.rotation), normalised(self.tool))


class Task(Contract):
    """The insertion itself. Heights are those of the TCP in the work-object frame."""

    approach_z_mm: float = 35.0  # held 30 mm above its bottom, which is approach_clearance_mm above the blocks
    approach_clearance_mm: Positive = 5.0
    approach_y_mm: float = 0.0
    gap_width_mm: float = Field(default=56.0, gt=0, le=1000)
    expected_depth_mm: float = Field(default=25.0, gt=0, le=1000)
    depth_tolerance_mm: Positive = 1.0
    creep_allowance_mm: float = Field(default=0.0, ge=0, le=50)  # deeper for an object pushed up in the hand: if free
    max_no_decisions: int = Field(default=2, ge=0, le=15)

    @property
    def grasp_height_mm(self) -> float | None:
        """The TCP's height when the object touches the blocks' tops; None where the approach is too low to tell."""
        height_mm = self.approach_z_mm - self.approach_clearance_mm
        return height_mm if height_mm > 0 else None


class Robot(Contract):
    """Which way the arm is driven: over EGM, or by our RAPID socket modules on a controller without that option."""

    link: Literal["egm", "socket"] = "egm"


class Settings(Contract):
    """Everything; each section has the defaults of its module."""

    robot: Robot = Robot()
    socket: SocketSettings = SocketSettings()
    service: ServiceSettings = ServiceSettings()
    rws: RwsSettings = RwsSettings()
    egm: EgmSettings = EgmSettings()
    gripper: WsgSettings = WsgSettings()
    work_object: WorkObject = WorkObject()
    limits: Limits = Limits()
    ramps: Ramps = Ramps()
    timeouts: Timeouts = Timeouts()
    task: Task = Task()


def load_settings(path: Path | None, overrides: dict[str, dict[str, Any]] | None = None) -> Settings:
    """Settings of a TOML file (None: defaults) with ``overrides`` by section on top; raises SettingsError.

    The RWS password may come from the environment instead of the file.
    """
    data: dict[str, Any] = {}
    if path is not None:
        try:
            data = read_toml(path)
        except (OSError, ContractError) as error:
            raise SettingsError(f"cannot read configuration {path}: {error}") from None
    for section, values in (overrides or {}).items():
        given = {key: value for key, value in values.items() if value is not None}
        if given and isinstance(data.get(section, {}), dict):  # what is no table is refused below
            data[section] = {**data.get(section, {}), **given}
    try:
        settings = Settings.model_validate_json(json.dumps(data))
        settings.work_object.frame()
    except ValidationError as error:
        raise SettingsError(f"{path or 'configuration'}: {first_error(error, 'file')}") from None
    except (ValueError, TypeError) as error:
        raise SettingsError(f"{path or 'configuration'}: {error}") from None
    password = os.environ.get(PASSWORD_VARIABLE)
    if password:
        rws = settings.rws.model_copy(update={"password": SecretStr(password)})
        settings = settings.model_copy(update={"rws": rws})
    return settings
