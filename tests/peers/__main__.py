"""Every peer that meets this software, on what is installed here: runs their tests and writes docs/peers.md and .json.

``python -m tests.peers [PACKAGE ...]`` (``make peers`` installs what is missing first). A peer that is absent is a row
that says so; rows of packages that are not named stay as they were kept.
"""

import json
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path

from reporting import page as pages
from reporting.table import table

ROOT = Path(__file__).parents[2]
EMULATORS = "tests/simulation/cell/emulators"
GUIDES = "tests/robot_client/robots/abb_egm/test_third_party.py"
READERS = os.environ.get("PEERS_PYTHON", sys.executable)
OLD_RUNTIME = os.environ.get("OLD_RUNTIME_PYTHON", sys.executable)


@dataclass(frozen=True)
class Peer:
    """A package, what of it was exercised, the tests that do, and the interpreter that has it."""

    package: str
    exercised: str
    tests: tuple[str, ...]
    python: str = sys.executable


PEERS = (
    Peer("websockets", "examples/cell_controller.py: an insertion, and every fault", ("tests/examples",)),
    Peer(
        "abb-robot-client",
        "RWS 1.0: panel, execution, tasks, signals, speed, files, joints and pose, log, subscriptions; EGM guidance",
        (
            f"{EMULATORS}/test_emulator_rws.py::test_the_stock_rws_client_uses_users_and_files",
            f"{EMULATORS}/test_emulator_rws.py::test_the_stock_rws_client_subscribes",
            f"{GUIDES}::test_abb_robot_client_starts_guides_and_stops_the_emulated_robot",
        ),
    ),
    Peer(
        "ABBRobotEGM",
        "EGM guidance of the emulated arm",
        ("tests/robot_client/robots/abb_egm/test_third_party.py::test_abbrobotegm_guides_what_our_rws_client_started",),
    ),
    Peer(
        "tritonclient", "Open Inference Protocol: every endpoint, JSON and binary", ("tests/service/web/test_oip.py",)
    ),
    Peer(
        "schemathesis",
        "every operation of /openapi.json: answers, statuses, content types, headers",
        ("tests/service/web/test_fuzz.py::test_no_request_makes_the_service_fail_and_every_answer_is_as_described",),
    ),
    Peer(
        "mcap", "a recording: schemas, JSON against them, attachments", ("tests/service/recordings/test_described.py",)
    ),
    Peer(
        "rerun-sdk",
        "a recording: every frame of both fingers is a picture",
        ("tests/service/recordings/test_peers.py::test_rerun_has_every_frame_of_both_fingers_as_a_picture",),
        READERS,
    ),
    Peer(
        "foxglove-sdk",
        "a recording: its own encoder writes the same bytes",
        ("tests/service/recordings/test_peers.py::test_foxglove_s_sdk_writes_the_same_bytes",),
        READERS,
    ),
    Peer("onnxruntime", "oldest: exported networks", ("tests/export/onnx/test_runtimes.py",), OLD_RUNTIME),
    Peer("onnxruntime", "newest: exported networks", ("tests/export/onnx/test_export.py",)),
)


BEFORE = """
# Peers

Foreign software that meets this one, unmodified, over real sockets and files, on the machine where `make peers` last
ran. `peers.json` keeps the same. Robot and gripper are emulated: no peer has met a device here.
"""
AFTER = """
What is known not to work, and why:

- `abb-robot-client` 0.4.0: `request_rmmp` and `poll_rmmp` join the controller's address to an address that is whole
  already, on any controller. Message queues (`*_ipc_*`) need option 616-1, which the emulated controller has not.
- `foxglove-sdk` writes recordings and reads none; its encoder is compared instead.
- LeRobot's own loader is not in the table: it brings torch and a gigabyte of packages. The tests read the export as its
  layout says.
"""


@dataclass(frozen=True)
class Result:
    """What came of a peer's tests; ``why`` names what was not run or failed."""

    package: str
    version: str
    exercised: str
    passed: int
    skipped: int
    failed: int
    why: str


def version(peer: Peer) -> str:
    """The installed version of a peer's package, ``absent`` where there is none."""
    if peer.python == sys.executable:
        try:
            return metadata.version(peer.package)
        except metadata.PackageNotFoundError:
            return "absent"
    code = f"from importlib.metadata import version; print(version({peer.package!r}))"
    done = subprocess.run([peer.python, "-c", code], capture_output=True, text=True, check=False)
    return done.stdout.strip() or "absent"


def run(peer: Peer) -> Result:
    """Run a peer's tests in a process of their own."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [
            sys.executable,
            "-m",
            "pytest",
            "-n",
            "0",
            "-q",
            "-m",
            "not slow",
            f"--junitxml={report}",
            *peer.tests,
        ]
        subprocess.run(command, cwd=ROOT, check=False, stdout=subprocess.DEVNULL)
        cases = list(ET.parse(report).iter("testcase"))
    found: Counter[str] = Counter()
    why: dict[str, None] = {}
    for case in cases:
        kinds = [child for child in case if child.tag in {"skipped", "failure", "error"}]
        found[kinds[0].tag if kinds else "passed"] += 1
        why |= dict.fromkeys(f"{case.get('name')}: {child.get('message', '').splitlines()[0]}" for child in kinds)
    failed = found["failure"] + found["error"]
    told = (peer.package, version(peer), peer.exercised, found["passed"], found["skipped"], failed)
    return Result(*told, "; ".join(why))


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
    """Run the peers of these names, all without names, and write both files after each; 1 if anything failed.

    The rows of the others stay what they were.
    """
    kept = ROOT / "docs/peers.json"
    results = (
        {result["exercised"]: Result(**result) for result in json.loads(kept.read_text())} if kept.exists() else {}
    )
    for peer in PEERS:
        if not names or peer.package in names:
            results[peer.exercised] = run(peer)
            rows = [results[one.exercised] for one in PEERS if one.exercised in results]
            pages.publish(kept.parent, "peers", page(rows), [asdict(row) for row in rows])
    return int(any(result.failed for result in results.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
