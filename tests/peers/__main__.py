"""Every peer that meets this software, on what is installed here: runs their tests and writes docs/peers.md and .json.

``python -m tests.peers [PACKAGE ...]`` (``make peers`` installs what is missing first). A peer that is absent is a row
that says so; rows of packages that are not named stay as they were kept.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from reporting import page as pages
from reporting.table import table

ROOT = Path(__file__).parents[2]
EMULATORS = "tests/simulation/cell/emulators"
EGM = "tests/robot_client/robots/abb_egm/test_third_party.py"
RUNTIMES = "tests/export/onnx/test_runtimes.py"
RECORDINGS = "tests/service/recordings"
EXPORT = "tests/simulation/data/test_export_dataset.py"


@dataclass(frozen=True)
class Peer:
    """A foreign package, what of it was exercised, and the tests that do.

    ``python`` is the variable that names its interpreter, where it has one of its own; ``asked`` is the command that
    tells its version, where it is no Python package.
    """

    package: str
    exercised: str
    tests: tuple[str, ...]
    python: str = ""
    asked: tuple[str, ...] = ()


PEERS = (
    Peer("websockets", "examples/cell_controller.py: an insertion, and every fault", ("tests/examples",)),
    Peer(
        "abb-robot-client",
        "RWS 1.0: every method of its client; subscriptions",
        (f"{EMULATORS}/test_emulator_rws.py::test_every_method_of_the_stock_rws_client_does_what_it_says",),
    ),
    Peer(
        "abb-robot-client",
        "EGM guidance of the emulated arm",
        (f"{EGM}::test_abb_robot_client_starts_guides_and_stops_the_emulated_robot",),
    ),
    Peer(
        "ABBRobotEGM",
        "EGM guidance of the emulated arm; the fields of RobotWare 7",
        (
            f"{EGM}::test_abbrobotegm_guides_what_our_rws_client_started",
            f"{EGM}::test_what_abbrobotegm_knows_of_robotware_7_is_read_and_a_collision_ends_guidance",
        ),
    ),
    Peer(
        "tritonclient", "Open Inference Protocol: every endpoint, JSON and binary", ("tests/service/web/test_oip.py",)
    ),
    Peer(
        "kserve",
        "Open Inference Protocol: its models of the protocol read our answers, and write a request",
        ("tests/service/web/test_kserve.py",),
        "KSERVE_PYTHON",
    ),
    Peer(
        "schemathesis",
        "every operation of /openapi.json, 30 requests each: answers, statuses, content types, headers",
        ("tests/service/web/test_fuzz.py::test_many_requests_do_not_make_the_service_fail",),
    ),
    Peer("mcap", "a recording: schemas, JSON against them, attachments", (f"{RECORDINGS}/test_described.py",)),
    Peer(
        "rerun-sdk",
        "recordings, one of them at 2 x 60 Hz with four viewers: every frame of both fingers decoded",
        (
            f"{RECORDINGS}/test_peers.py::test_rerun_has_every_frame_of_both_fingers_as_a_picture",
            f"{RECORDINGS}/test_peers.py::test_rerun_has_every_frame_recorded_at_60_hz_with_four_viewers",
        ),
        "PEERS_PYTHON",
    ),
    Peer(
        "foxglove-sdk",
        "a recording: its own encoder writes the same bytes",
        (f"{RECORDINGS}/test_peers.py::test_foxglove_s_sdk_writes_the_same_bytes",),
        "PEERS_PYTHON",
    ),
    Peer(
        "lerobot",
        "an exported dataset: its own loader, and statistics by episode",
        (f"{EXPORT}::test_lerobot_s_own_loader_reads_every_frame_and_agrees_with_the_statistics",),
        "LEROBOT_PYTHON",
    ),
    Peer(
        "onnxruntime",
        "oldest: networks exported now and the released ones",
        (f"{RUNTIMES}::test_the_oldest_runtime_says_what_the_newest_says",),
        "OLD_RUNTIME_PYTHON",
    ),
    Peer(
        "onnxruntime",
        "newest: networks exported now",
        ("tests/export/onnx/test_export.py::test_released_models_verify",),
    ),
    Peer(
        "openvino",
        "networks exported now and the released ones",
        (f"{RUNTIMES}::test_openvino_says_what_onnxruntime_says",),
        "GRAPH_PYTHON",
    ),
    Peer(
        "onnxsim",
        "networks exported now and the released ones, simplified",
        (f"{RUNTIMES}::test_onnxsim_simplifies_it_to_a_graph_that_says_the_same",),
        "GRAPH_PYTHON",
    ),
    Peer(
        "promtool",
        "configuration, alerts against their tests, metrics of a running service",
        ("tests/service/observability/test_promtool.py",),
        asked=("promtool", "--version"),
    ),
    Peer(
        "Chromium",
        "the page on four panels, light and dark, by mouse and keyboard; axe",
        ("tests/service/web/test_dashboard.py",),
        asked=("chromium", "--version"),
    ),
)


BEFORE = """
# Peers

Foreign software that runs against this project unmodified, over real sockets and files, on the machine where `make
peers` last ran. `peers.json` has the same rows. Robot and gripper are emulated: no peer was tested on a device.
"""
AFTER = """
Known limitations:

- `abb-robot-client` 0.4.0: `request_rmmp` and `poll_rmmp` prepend the address of the controller to a complete URL, on
  any controller. Its asyncio client `rws_aio` is not valid Python: the released file lacks a colon.
- `schemathesis` tests one HTTP parser, h11. The service does not use `httptools`.
- `foxglove-sdk` writes recordings but reads none. Its encoder is compared instead.
- `lerobot` brings a CUDA build of torch, 8 GB in all. `make peers LEROBOT=1` installs it; otherwise its row stays as it
  is.

Tested by hand, because no package has it: the C++ demo of
[drake-schunk-driver](https://github.com/RobotLocomotion/drake-schunk-driver), unmodified except for the address, homes,
moves and grasps with the emulated WSG-50 over UDP.
"""


@dataclass(frozen=True)
class Result:
    """Outcome of a peer's tests; ``why`` names the ones not run or failed."""

    package: str
    version: str
    exercised: str
    passed: int
    skipped: int
    failed: int
    why: str


def version(peer: Peer) -> str:
    """The installed version of a peer, ``absent`` if there is none."""
    python = os.environ.get(peer.python, "") if peer.python else sys.executable
    code = f"from importlib.metadata import version; print(version({peer.package!r}))"
    command = peer.asked or (python, "-c", code)
    if not shutil.which(command[0]):
        return "absent"
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    number = re.search(r"\d+(\.\d+)+", done.stdout)
    return number[0] if number else "absent"


def run(peer: Peer) -> Result:
    """Run a peer's tests in a process of their own."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        options = ("-n", "0", "-q", "--timeout=1200", f"--junitxml={report}")
        command = [sys.executable, "-m", "pytest", *options, *peer.tests]
        subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.DEVNULL)
        cases = list(ET.parse(report).iter("testcase"))
    counts: Counter[str] = Counter()
    why: dict[str, None] = {}
    for case in cases:
        kinds = [child for child in case if child.tag in {"skipped", "failure", "error"}]
        counts[kinds[0].tag if kinds else "passed"] += 1
        why |= dict.fromkeys(f"{case.get('name')}: {child.get('message', '').splitlines()[0]}" for child in kinds)
    failed = counts["failure"] + counts["error"]
    row = (peer.package, version(peer), peer.exercised, counts["passed"], counts["skipped"], failed)
    return Result(*row, "; ".join(why))


def page(results: list[Result]) -> str:
    """The page, from kept results."""
    made = table(
        results,
        ("package", "package"),
        ("version", "version"),
        ("exercised", "exercised"),
        ("tests", lambda r: f"{r.passed} passed, {r.skipped} skipped, {r.failed} failed"),
        ("why not", lambda r: r.why or "-"),
    )
    return pages.page(BEFORE, made, AFTER)


def main(names: list[str]) -> int:
    """Run the peers of these names, all without names, and write both files after each; 1 unless each row is green.

    A row is green if all of its tests ran and passed. The rows of the others stay what they were; without names 1 also
    where a peer is absent, but for the one of 8 GB that only `LEROBOT=1` installs.
    """
    kept = ROOT / "docs/peers.json"
    results = (
        {(result["package"], result["exercised"]): Result(**result) for result in json.loads(kept.read_text())}
        if kept.exists()
        else {}
    )
    asked = [peer for peer in PEERS if peer.package in names or not names]
    absent = [peer for peer in asked if version(peer) == "absent"]
    bad = [f"{peer.package}: absent" for peer in absent if names or peer.python != "LEROBOT_PYTHON"]
    bad += [f"{name}: no peer of this name" for name in names if name not in {peer.package for peer in PEERS}]
    for peer in asked:
        if peer not in absent:
            result = results[peer.package, peer.exercised] = run(peer)
            bad += [] if result.passed and not result.failed + result.skipped else [f"{peer.package}: {result.why}"]
            rows = [outcome for one in PEERS if (outcome := results.get((one.package, one.exercised)))]
            pages.publish(kept.parent, "peers", page(rows), [asdict(row) for row in rows])
    for line in bad:
        print(f"not green: {line}", file=sys.stderr)
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
