"""Recordings in the hands of strangers: Foxglove's own reader, and Rerun.

Neither is a dependency; a test whose reader is missing is skipped. ``pip install rerun-sdk`` (its command ``rerun`` on
the path), and for Foxglove's reader a folder named by
``FOXGLOVE_NODE_MODULES`` in which ``npm install @mcap/core @mcap/support @foxglove/schemas protobufjs`` was done.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import pytest

from service.cameras.capture import CameraFrame
from service.contract import FINGERS, FrameSpec, TactileFrame, wire
from service.perception.finger import TactileFinger as Watch
from service.recordings.writer import Recorder
from tests.service import drawn

FRAMES_N = 4
JPEG, RAW = "/left/image", "/right/image"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The left camera sends JPEG, the right one raw pixels; with markers, a message and a call."""
    recorder = Recorder(tmp_path_factory.mktemp("readers"), "strangers", {})
    spec = FrameSpec(width_px=327, height_px=320)
    for finger in FINGERS:
        watch = Watch(finger, spec, drawn.calibration().camera(finger))
        for index in range(FRAMES_N):
            pixels = drawn.raw(finger, index, 10, 16)
            jpeg = cv2.imencode(".jpg", pixels)[1].tobytes() if finger == "left" else None
            frame = TactileFrame(finger, index, 1_000_000_000 + index * 33_000_000, pixels)
            recorder.frame(CameraFrame(frame, jpeg))
            recorder.observation(watch.observe(frame))
    abort = wire.Abort(insertion_id="strangers", cause="operator", reason="x").model_dump(mode="json")
    recorder.message("client", abort, 1_100_000_000)
    recorder.call({"call": "message", "message": abort}, 1_100_000_000)
    return recorder.close({"outcome": "aborted"})


@pytest.mark.slow
def test_foxglove_s_own_reader_reads_every_message(recording: Path) -> None:
    modules, node = os.environ.get("FOXGLOVE_NODE_MODULES"), shutil.which("node")
    if not (modules and node):
        pytest.skip("set FOXGLOVE_NODE_MODULES to the folder of its npm packages")
    script = Path(__file__).with_name("read_mcap.mjs")
    topics = json.loads(subprocess.check_output([node, script, modules, recording], text=True))
    assert {topic: entry["n"] for topic, entry in topics.items()} == {
        **{f"/{finger}/{kind}": FRAMES_N for finger in FINGERS for kind in ("image", "markers")},
        "/messages": 1,
        "/calls": 1,
    }
    for topic in (JPEG, RAW):
        assert topics[topic]["published"] == topics[topic]["keys"]
        assert topics[topic]["wrong_times"] == 0
    assert (topics[JPEG]["schema"], topics[JPEG]["format"]) == ("foxglove.CompressedImage", "jpeg")
    assert (topics[RAW]["schema"], topics[RAW]["encoding"]) == ("foxglove.RawImage", "bgr8")


@pytest.mark.slow
def test_rerun_finds_nothing_wrong_and_knows_the_pictures_as_pictures(recording: Path, tmp_path: Path) -> None:
    rerun = shutil.which("rerun")
    if rerun is None:
        pytest.skip("rerun is not installed")

    def run(*arguments: object) -> str:
        return subprocess.run([rerun, *map(str, arguments)], check=True, capture_output=True, text=True).stdout

    checked = [line.split()[0] for line in run("mcap", "check", recording).splitlines() if "/" in line.rsplit("—")[0]]
    assert checked.count("ok") == 6
    run("mcap", "convert", recording, "-o", tmp_path / "out.rrd")
    run("rrd", "verify", tmp_path / "out.rrd")
    printed = run("rrd", "print", "-v", tmp_path / "out.rrd")
    assert f"{JPEG}@EncodedImage:blob" in printed
    assert f"{RAW}@Image:buffer" in printed
    assert "/left/markers@tactile_insertion.Markers" in printed
