"""Types that the packages exchange: frames, model cards and wire messages.

Pure data: numpy and pydantic only. This is the only part of the service that the other packages may import.
"""

from service.contract.frames import (
    FINGERS,
    ContractError,
    Finger,
    FramePair,
    FrameSpec,
    TactileFrame,
    decode_frame,
    encode_frame,
    encoded_bytes,
)
from service.contract.model_card import CARD_KEY, Calibration, ErrorClass, ModelCard
from service.contract.sensor import MarkerSpec, Sensor

__all__ = [
    "CARD_KEY",
    "FINGERS",
    "Calibration",
    "ContractError",
    "ErrorClass",
    "Finger",
    "FramePair",
    "FrameSpec",
    "MarkerSpec",
    "ModelCard",
    "Sensor",
    "TactileFrame",
    "decode_frame",
    "encode_frame",
    "encoded_bytes",
]
