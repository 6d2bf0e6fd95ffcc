"""A recording of the live service in strangers' hands: Rerun finds every frame, Foxglove's SDK writes the same bytes.

Both are large and not needed to run anything: ``PEERS_PYTHON`` names an interpreter that has them (`make peers`).
"""

import base64
import contextlib
import json
import os
import subprocess
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader

from tests.service.apart import Apart, apart
from tests.service.client import greeted
from tests.service.conftest import LiveService

PICTURES = {"/left/image", "/right/image"}
SCRIPT = """
import base64, json, sys
from foxglove.messages import CompressedImage, Timestamp
same = 0
for line in sys.stdin:
    said = json.loads(line)
    made = CompressedImage(
        timestamp=Timestamp(sec=said["sec"], nsec=said["nsec"]),
        frame_id=said["frame_id"], data=base64.b64decode(said["data"]), format=said["format"],
    )
    same += made.encode() == base64.b64decode(said["recorded"])
schema = CompressedImage.get_schema()
print(json.dumps([same, schema.name, schema.encoding]))
"""
RERUN = """
import collections, io, json, sys
from PIL import Image
from rerun.chunk import McapReader
found, sizes = collections.Counter(), set()
for chunk in McapReader(sys.argv[1]).stream().to_chunks():
    batch = chunk.to_record_batch()
    for name in batch.schema.names:
        if name.endswith("EncodedImage:blob"):
            for row in batch.column(name).to_pylist():
                image = Image.open(io.BytesIO(bytes(row[0])))
                image.load()
                sizes.add(image.size)
                found[str(chunk.entity_path)] += 1
assert len(sizes) == 1, sizes
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def python() -> str:
    path = os.environ.get("PEERS_PYTHON")
    if not path:
        pytest.skip("set PEERS_PYTHON to a Python with rerun-sdk and foxglove-sdk (make peers does)")
    return path


@pytest.fixture(scope="module")
def recording(live: LiveService) -> Path:
    driver = greeted(live, "peers")
    driver.attempt(1)
    path = driver.insert(2).recording
    driver.close()
    return Path(path)


def pictures(recording: Path) -> dict[str, list[bytes]]:
    """The recorded pictures by topic, as the reference reader finds them."""
    pictures: dict[str, list[bytes]] = {topic: [] for topic in PICTURES}
    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(PICTURES)):
            pictures[channel.topic].append(message.data)
    return pictures


def decoded_by_rerun(python: str, recording: Path) -> dict[str, int]:
    """Number of pictures that Rerun finds under each topic and can decode to pixels of one size."""
    done = subprocess.run([python, "-c", RERUN, str(recording)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    counts: dict[str, int] = json.loads(done.stdout)
    return counts


def test_rerun_has_every_frame_of_both_fingers_as_a_picture(python: str, recording: Path) -> None:
    recorded = {topic: len(messages) for topic, messages in pictures(recording).items()}
    assert min(recorded.values()) > 20
    assert decoded_by_rerun(python, recording) == recorded


@contextlib.contextmanager
def watched(live: Apart) -> Iterator[None]:
    """Two viewers of each camera."""
    stop = threading.Event()

    def look(finger: str) -> None:
        with httpx.stream("GET", live.url(f"/v1/cameras/{finger}/stream.mjpg"), timeout=30.0) as stream:
            for _ in stream.iter_bytes():
                if stop.is_set():
                    return

    with ThreadPoolExecutor(4) as pool:
        viewers = [pool.submit(look, finger) for finger in ("left", "right", "left", "right")]
        try:
            yield
        finally:
            stop.set()
        for viewer in viewers:
            viewer.result(60.0)


@pytest.mark.slow
def test_rerun_has_every_frame_recorded_at_60_hz_with_four_viewers(
    python: str, tmp_path: Path, models_folder: Path
) -> None:
    with apart(tmp_path, models_folder, 60.0) as live, watched(live):
        paths = []
        for number in range(8):
            driver = greeted(live, f"under-load-{number}")
            paths.append(Path(driver.insert(1).recording))
            driver.close()
        rates = {one["finger"]: one["frame_rate_hz"] for one in httpx.get(live.url("/v1/cameras")).json()["cameras"]}
    recorded = [{topic: len(messages) for topic, messages in pictures(path).items()} for path in paths]
    decoded = [decoded_by_rerun(python, path) for path in paths]
    print(f"at {rates} Hz, recorded {recorded}, decoded by Rerun {decoded}")
    assert sum(min(counts.values()) for counts in recorded) > 100
    assert decoded == recorded


def test_foxglove_s_sdk_writes_the_same_bytes(python: str, recording: Path) -> None:
    messages = [message for topic in PICTURES for message in pictures(recording)[topic]]
    lines = []
    for message in messages:
        image = CompressedImage.FromString(message)
        fields = {"sec": image.timestamp.seconds, "nsec": image.timestamp.nanos, "frame_id": image.frame_id}
        fields |= {"format": image.format, "data": base64.b64encode(image.data).decode()}
        lines.append(json.dumps(fields | {"recorded": base64.b64encode(message).decode()}))
    text = "\n".join(lines)
    done = subprocess.run([python, "-c", SCRIPT], input=text, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [len(messages), "foxglove.CompressedImage", "protobuf"]
