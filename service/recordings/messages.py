"""Frames and what was felt in them, in the form of a recording's topics."""

from typing import Any

import numpy as np

from service.cameras.capture import CameraFrame
from service.perception.observation import Observation
from service.recordings.schemas import CompressedImage, RawImage


def image_message(camera_frame: CameraFrame) -> tuple[Any, dict[str, Any]]:
    """A frame in Foxglove's form: the camera's own JPEG, or raw pixels; without its time."""
    frame = camera_frame.frame
    if camera_frame.jpeg is not None:
        return CompressedImage, {"frame_id": frame.finger, "data": camera_frame.jpeg, "format": "jpeg"}
    height, width = frame.pixels.shape[:2]
    size = {"width": width, "height": height, "encoding": "bgr8", "step": 3 * width}
    data = np.ascontiguousarray(frame.pixels).data.cast("B")  # the recorder's thread copies it, not the caller
    return RawImage, {"frame_id": frame.finger, "data": data} | size


def markers_message(observation: Observation) -> dict[str, Any]:
    """Markers and slip of one frame, without its time."""
    rows, cols = observation.field.valid.shape
    return {
        "seq": observation.seq,
        "rows": rows,
        "cols": cols,
        "rest_px": np.array(observation.field.rest_px, np.float32),
        "displacement_px": np.array(observation.field.displacement_px, np.float32),
        "residual_px": np.array(observation.slip.residual_px, np.float32),
        "valid": observation.field.valid.astype(np.uint8).tobytes(),
        "state": observation.slip.state,
        "slip_score": float(observation.slip.score),
        "slipping": observation.slip.slipping.astype(np.uint8).tobytes(),
        "sticking": observation.slip.sticking.astype(np.uint8).tobytes(),
    }
