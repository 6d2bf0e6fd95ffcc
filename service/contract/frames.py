"""Tactile frames and their one binary encoding, shared by HTTP, WebSocket and recordings.

Finger frame (each finger in its own view, so that a half turn of the cell swaps the two streams unflipped):
the camera image has u to the right and v down, v = -z of the cell. Finger "left" sits at +y and has u = +x,
finger "right" sits at -y and has u = -x, with x, y, z the work-object frame (x across the gap, z up).
"""

import math
import struct
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

Finger = Literal["left", "right"]
FINGERS: tuple[Finger, Finger] = get_args(Finger)

MAX_SIDE_PX = 4096
_MAGIC = b"TIF1"
_HEADER = struct.Struct("<4sBBHHHQQ")  # magic, finger, channels, height, width, reserved, seq, captured_ns


class ContractError(ValueError):
    """A message, frame or card breaks the contract; the text names the fault and the expectation."""


class Contract(BaseModel):
    """Base of every contract type: frozen, strict, finite numbers only, unknown keys refused."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


def first_error(error: ValidationError, whole: str = "contents") -> str:
    """The first error of a validation, as "key.below: error"; ``whole`` names a part without a key."""
    first = error.errors()[0]
    return f"{'.'.join(str(part) for part in first['loc']) or whole}: {first['msg']}"


def differing(one: object, other: object) -> str:
    """A value as text; of a contract type's, beside another of its type, only the fields that differ."""
    if not isinstance(one, Contract) or type(one) is not type(other):
        return str(one)
    return ", ".join(f"{name} {value}" for name, value in one if value != getattr(other, name))


class FrameSpec(Contract):
    """Format of a camera frame or a network input; a colour swap passes every shape check, so its order is declared.

    Nothing here swaps colours: a network that reads another order is refused.
    """

    height_px: int = Field(gt=0, le=MAX_SIDE_PX)
    width_px: int = Field(gt=0, le=MAX_SIDE_PX)
    colour: Literal["bgr"] = "bgr"
    rectified: bool = True

    @property
    def shape(self) -> tuple[int, int, int]:
        """(height_px, width_px, 3), the shape of a frame's pixels."""
        return (self.height_px, self.width_px, 3)

    def check(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return ``pixels`` if they are uint8 of this spec's shape; raise ContractError otherwise."""
        if pixels.dtype != np.uint8 or pixels.shape != self.shape:
            raise ContractError(f"frame is {pixels.dtype}{list(pixels.shape)}, expected uint8{list(self.shape)}")
        return pixels


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One camera frame.

    ``pixels`` is uint8 [height, width, 3] in BGR order. ``captured_ns`` is the monotonic clock of the machine that
    captured it; it is only ever compared with stamps of the same machine. ``seq`` counts up per finger.
    """

    finger: Finger
    seq: int
    captured_ns: int
    pixels: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class FramePair:
    """The two fingers' frames that belong to one instant (skew bounded by the pairing rule of the cameras)."""

    left: TactileFrame
    right: TactileFrame

    @property
    def seq(self) -> int:
        """Sequence number of the pair: that of the left finger."""
        return self.left.seq

    @property
    def captured_ns(self) -> int:
        """Capture time of the later of the two frames."""
        return max(self.left.captured_ns, self.right.captured_ns)


def encoded_bytes(spec: FrameSpec) -> int:
    """Size of :func:`encode_frame`'s result for a frame of this size."""
    return _HEADER.size + math.prod(spec.shape)


def encode_frame(frame: TactileFrame) -> bytes:
    """Header and raw row-major pixels; the inverse of :func:`decode_frame`."""
    height, width, channels = frame.pixels.shape
    header = _HEADER.pack(_MAGIC, FINGERS.index(frame.finger), channels, height, width, 0, frame.seq, frame.captured_ns)
    return header + np.ascontiguousarray(frame.pixels).tobytes()


def decode_frame(message: bytes, spec: FrameSpec | None = None) -> TactileFrame:
    """Read a frame back; raise ContractError on any wrong length, magic, size or, with ``spec``, shape."""
    if len(message) < _HEADER.size:
        raise ContractError(f"binary frame of {len(message)} bytes, expected at least {_HEADER.size} bytes of header")
    magic, finger, channels, height, width, _, seq, captured_ns = _HEADER.unpack_from(message)
    if magic != _MAGIC:
        raise ContractError(f"binary frame starts with {magic!r}, expected {_MAGIC!r}")
    if finger >= len(FINGERS) or channels != 3 or not (0 < height <= MAX_SIDE_PX and 0 < width <= MAX_SIDE_PX):
        raise ContractError(
            f"binary frame header says finger {finger}, {height} x {width} x {channels};"
            f" expected finger 0 or 1, sides 1..{MAX_SIDE_PX}, 3 channels"
        )
    expected = _HEADER.size + height * width * channels
    if len(message) != expected:
        raise ContractError(f"binary frame of {len(message)} bytes, expected {expected} for {height} x {width} x 3")
    pixels = np.frombuffer(message, np.uint8, offset=_HEADER.size).reshape(height, width, channels)
    if spec is not None:
        spec.check(pixels)
    return TactileFrame(FINGERS[finger], seq, captured_ns, pixels)
