"""Every fault that the emulated devices can show, as one typed record.

``POST /faults`` of the cell's admin port replaces the named fields and leaves the others; ``DELETE /faults`` restores
health. Switches stay on until they are reset; counts are used up by the next bytes that leave the device.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from service.contract.frames import first_error

Share = Annotated[float, Field(ge=0, le=1)]
Delay = Annotated[float, Field(ge=0, le=60_000)]
Count = Annotated[int, Field(ge=0, le=1_000_000)]


class FaultError(ValueError):
    """The request names a fault that no emulator knows, or a value out of range."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, validate_assignment=True)


class EgmFaults(_Section):
    """Faults of the 250 Hz UDP stream."""

    delay_ms: Delay = 0.0  # every datagram, both ways
    drop_share: Share = 0.0  # of the datagrams robot -> guide
    silent: bool = False  # nothing is sent, the arm keeps following: the stream alone is lost
    frozen: bool = False  # the same datagram again and again: a frozen stream that still arrives
    garbage_next: Count = 0  # this many datagrams carry random bytes
    ignore_guide: bool = False  # what the guide sends never reaches the controller


class RwsFaults(_Section):
    """Faults of Robot Web Services."""

    delay_ms: Delay = 0.0
    refuse_next: Count = 0  # this many requests get 503
    reset_next: Count = 0  # this many connections are cut without an answer
    garbage_next: Count = 0  # this many answers are malformed
    stop_ignored: bool = False  # 204 for stop, but the program keeps running


class WsgFaults(_Section):
    """Faults of the gripper's TCP connection."""

    delay_ms: Delay = 0.0
    silent: bool = False
    wrong_crc_next: Count = 0
    garbage_next: Count = 0  # random bytes before this many frames
    reset_now: bool = False  # an event: the connection is cut, then the switch is off again
    refuse_connections: bool = False


class CameraFaults(_Section):
    """Faults of one camera stream."""

    delay_ms: Delay = 0.0
    stall: bool = False  # the connection stays, no frame comes
    disconnect: bool = False  # the connection is closed and new ones are closed at once
    duplicate: bool = False  # the same frame with the same stamp again
    drop_share: Share = 0.0
    garbage_next: Count = 0  # this many parts are not a JPEG
    half_size: bool = False  # frames come at half their width and height
    black: bool = False
    frozen_noise: bool = False  # the same picture again and again, each with new noise of two grey levels
    unstamped: bool = False  # parts carry no capture time


class RobotFaults(_Section):
    """Faults of the arm's cabinet, as an operator or a safety device would cause them."""

    protective_stop: bool = False
    emergency_stop: bool = False
    motors_off: bool = False
    mode: Literal["AUTO", "MANR", "MANF"] = "AUTO"
    egm_lag_ms: Annotated[float, Field(ge=1, le=500)] | None = None  # None: as configured


class GripperFaults(_Section):
    """Faults of the gripper itself."""

    part_lost: bool = False  # the held part is lost
    not_homed: bool = False
    fast_stop: bool = False  # an event: latches FAST STOP until it is acknowledged
    temperature_warning: bool = False


class Faults(_Section):
    """All faults of the cell; the default is a healthy one."""

    egm: EgmFaults = EgmFaults()
    rws: RwsFaults = RwsFaults()
    wsg: WsgFaults = WsgFaults()
    camera_left: CameraFaults = CameraFaults()
    camera_right: CameraFaults = CameraFaults()
    robot: RobotFaults = RobotFaults()
    gripper: GripperFaults = GripperFaults()


class FaultBoard:
    """The live faults; every emulator holds the board and reads its own section when it acts."""

    def __init__(self) -> None:
        self.faults = Faults()

    def update(self, changes: dict[str, Any]) -> Faults:
        """Replace the named fields, ``{"egm": {"silent": true}}``; raise FaultError on a wrong one."""
        merged = self.faults.model_dump()
        for section, fields in changes.items():
            if section not in merged or not isinstance(fields, dict):
                raise FaultError(f"faults are grouped as {', '.join(merged)}; got {section!r}: {fields!r}")
            merged[section].update(fields)
        try:
            self.faults = Faults.model_validate(merged)
        except ValidationError as error:
            raise FaultError(f"fault {first_error(error)}") from error
        return self.faults

    def clear(self) -> Faults:
        self.faults = Faults()
        return self.faults


def take(section: _Section, field: str) -> bool:
    """Use up one unit of a ``*_next`` count or an event switch: True if it was set."""
    value = getattr(section, field)
    if value:
        setattr(section, field, value - 1 if not isinstance(value, bool) else False)
    return bool(value)
