"""Numbers of the WSG-50 protocol: status codes, command ids, flags and state bits."""

from enum import IntEnum, IntFlag


class Status(IntEnum):
    """Status codes of a reply."""

    SUCCESS = 0
    NOT_AVAILABLE = 1
    NO_SENSOR = 2
    NOT_INITIALIZED = 3
    ALREADY_RUNNING = 4
    FEATURE_NOT_SUPPORTED = 5
    INCONSISTENT_DATA = 6
    TIMEOUT = 7
    READ_ERROR = 8
    WRITE_ERROR = 9
    INSUFFICIENT_RESOURCES = 10
    CHECKSUM_ERROR = 11
    NO_PARAM_EXPECTED = 12
    NOT_ENOUGH_PARAMS = 13
    CMD_UNKNOWN = 14
    CMD_FORMAT_ERROR = 15
    ACCESS_DENIED = 16
    ALREADY_OPEN = 17
    CMD_FAILED = 18
    CMD_ABORTED = 19
    INVALID_HANDLE = 20
    NOT_FOUND = 21
    NOT_OPEN = 22
    IO_ERROR = 23
    INVALID_PARAMETER = 24
    INDEX_OUT_OF_BOUNDS = 25
    CMD_PENDING = 26
    OVERRUN = 27
    RANGE_ERROR = 28
    AXIS_BLOCKED = 29
    FILE_EXISTS = 30


class Command(IntEnum):
    """Command ids that this project uses or answers."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOMING = 0x20
    MOVE = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    GET_ACCELERATION = 0x31
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    GET_SOFT_LIMITS = 0x35
    CLEAR_SOFT_LIMITS = 0x36
    SYSTEM_STATE = 0x40
    GRASPING_STATE = 0x41
    WIDTH = 0x43
    SPEED = 0x44
    FORCE = 0x45
    SYSTEM_INFO = 0x50
    SYSTEM_LIMITS = 0x53


class HomingDirection(IntEnum):
    """End stop for referencing."""

    DEFAULT = 0
    OUTWARD = 1
    INWARD = 2


class MoveFlag(IntEnum):
    """Pre-position behaviour. Bit 0 means *relative* to the vendor and is never sent: the sources disagree on it."""

    CLAMP_ON_BLOCK = 0x00
    STOP_ON_BLOCK = 0x02


class UpdateFlag(IntFlag):
    """First byte of a state query."""

    ONCE = 0
    PERIODIC = 1
    ON_CHANGE = 2


class SystemState(IntFlag):
    """Bits of the system state (0x40)."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    AXIS_STOPPED = 1 << 6
    TARGET_POS_REACHED = 1 << 7
    OVERDRIVE_MODE = 1 << 8
    FORCE_CONTROL_MODE = 1 << 9
    FAST_STOP = 1 << 12
    TEMP_WARNING = 1 << 13
    TEMP_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURRENT_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    CMD_FAILURE = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_FAILURE = 1 << 20


FAULT_BITS = (
    SystemState.FAST_STOP
    | SystemState.TEMP_FAULT
    | SystemState.POWER_FAULT
    | SystemState.CURRENT_FAULT
    | SystemState.FINGER_FAULT
)


class GraspingState(IntEnum):
    """Value of the grasping state (0x41)."""

    IDLE = 0
    GRASPING = 1
    NO_PART = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7
