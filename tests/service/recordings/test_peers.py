"""A recording of the live service in strangers' hands: Rerun finds every frame, Foxglove's SDK writes the same bytes.

Both are large and not needed to run anything: ``PEERS_PYTHON`` names an interpreter that has them (`make peers`).
"""

import base64
import json
import os
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader

from tests.service.client import Driver
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


@pytest.fixture(scope="module")
def python() -> str:
    found = os.environ.get("PEERS_PYTHON")
    if not found:
        pytest.skip("set PEERS_PYTHON to a Python with rerun-sdk and foxglove-sdk (make peers does)")
    return found


@pytest.fixture(scope="module")
def recording(live: LiveService) -> Path:
    driver = Driver(live, "peers")
    driver.until("hello")
    driver.attempt(1)
    path = driver.insert(2).recording
    driver.close()
    return Path(path)


def pictures(recording: Path) -> dict[str, list[bytes]]:
    """The recorded pictures by topic, as the reference reader finds them."""
    found: dict[str, list[bytes]] = {topic: [] for topic in PICTURES}
    with recording.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(PICTURES)):
            found[channel.topic].append(message.data)
    return found


def test_rerun_has_every_frame_of_both_fingers_as_a_picture(python: str, recording: Path, tmp_path: Path) -> None:
    rerun = str(Path(python).with_name("rerun"))

    def run(*arguments: object) -> str:
        return subprocess.run([rerun, *map(str, arguments)], check=True, capture_output=True, text=True).stdout

    run("mcap", "convert", recording, "-o", tmp_path / "out.rrd")
    run("rrd", "verify", tmp_path / "out.rrd")
    decoded: Counter[str] = Counter()
    for line in run("rrd", "print", "-v", tmp_path / "out.rrd").splitlines():
        chunk = re.search(r"with (\d+) rows .* - (\S+) - data columns: .*@EncodedImage:blob", line)
        if chunk:
            decoded[chunk[2]] += int(chunk[1])
    recorded = {topic: len(messages) for topic, messages in pictures(recording).items()}
    assert min(recorded.values()) > 20
    assert decoded == recorded


def test_foxglove_s_sdk_writes_the_same_bytes(python: str, recording: Path) -> None:
    messages = [message for topic in PICTURES for message in pictures(recording)[topic]]
    lines = []
    for message in messages:
        image = CompressedImage.FromString(message)
        said = {"sec": image.timestamp.seconds, "nsec": image.timestamp.nanos, "frame_id": image.frame_id}
        said |= {"format": image.format, "data": base64.b64encode(image.data).decode()}
        lines.append(json.dumps(said | {"recorded": base64.b64encode(message).decode()}))
    text = "\n".join(lines)
    done = subprocess.run([python, "-c", SCRIPT], input=text, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [len(messages), "foxglove.CompressedImage", "protobuf"]
