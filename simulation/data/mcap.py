"""Trials as MCAP files that Foxglove and Rerun open: both fingers' images, the dots, wrench, depth and truth over time.

Messages are JSON with the public foxglove schemas where one exists, so that a viewer shows them without plugins.
"""

import base64
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from reporting.files import write_durably
from service.contract import FINGERS
from simulation.data.dataset import Dataset
from simulation.data.trial import FRAMES, SCALARS, Trial

_OBJECT = b'{"type":"object"}'
_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_IMAGE = json.dumps(
    {
        "title": "foxglove.CompressedImage",
        "type": "object",
        "properties": {
            "timestamp": _TIME,
            "frame_id": {"type": "string"},
            "data": {"type": "string", "contentEncoding": "base64"},
            "format": {"type": "string"},
        },
    }
).encode()


def export_trial(dataset: Dataset, number: int, path: Path) -> None:
    """Write trial ``number`` as one MCAP file, whole or not at all; frames are PNG, without loss."""
    from mcap.writer import Writer

    trial, frames = dataset.trial(number), dataset.frames(number, 0, FRAMES)
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="", library="tactile-insertion")
    writer.add_metadata("trial", {key: str(value) for key, value in truth(trial).items()})
    image_schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", _IMAGE)
    plain = writer.register_schema("tactile_insertion.Trial", "jsonschema", _OBJECT)
    images = [writer.register_channel(f"/{finger}/image", "json", image_schema) for finger in FINGERS]
    dots = [writer.register_channel(f"/{finger}/markers", "json", plain) for finger in FINGERS]
    state = writer.register_channel("/state", "json", plain)
    for k in range(FRAMES):
        stamp_ns = k * 1_000_000_000 // trial.sensor.fps
        values: list[tuple[int, dict[str, Any]]] = [(state, _state(trial, k))]
        for finger, name in enumerate(FINGERS):
            values.append((images[finger], _image(frames[k, finger], name, stamp_ns)))
            values.append((dots[finger], _markers(trial, k, finger)))
        for channel, value in values:
            data = json.dumps(value).encode()
            writer.add_message(channel, log_time=stamp_ns, data=data, publish_time=stamp_ns, sequence=k)
    writer.finish()
    write_durably(path, stream.getvalue())


def truth(trial: Trial) -> dict[str, Any]:
    """What is known of a trial besides its frames."""
    return {name: getattr(trial, name) for name in SCALARS if name != "scene_sha256"}


def _state(trial: Trial, k: int) -> dict[str, Any]:
    return {
        "frame": k,
        "depth_mm": float(trial.depth_mm[k]),
        "wrench_n_nmm": trial.wrench[k].tolist(),
        "in_hand_mm_rad": trial.in_hand[k].tolist(),
        "moving": k >= trial.onset_frame,
        "slipping": 0 <= trial.true_slip_frame <= k,
    }


def _image(frame: NDArray[np.uint8], finger: str, stamp_ns: int) -> dict[str, Any]:
    sec, nsec = divmod(stamp_ns, 1_000_000_000)
    data = base64.b64encode(cv2.imencode(".png", frame)[1].tobytes()).decode()
    return {"timestamp": {"sec": sec, "nsec": nsec}, "frame_id": finger, "data": data, "format": "png"}


def _markers(trial: Trial, k: int, finger: int) -> dict[str, Any]:
    gel = trial.gel[k, finger].astype(np.float32)
    displacement = (gel[..., :2] / trial.sensor.mm_per_px).round(3)
    return {
        "rest_px": trial.sensor.marker_rest_px().tolist(),
        "displacement_px": displacement.tolist(),
        "pressure_n_per_mm2": gel[..., 2].tolist(),
    }
