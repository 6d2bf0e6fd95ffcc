"""Tests of a copy of the repository in forks of a process that has imported it: a mutant costs its tests alone.

`python -m tests.mutants.forked` in the copy answers with a line once it has imported everything. Then it reads a
request a line, {"module", "tests", "timeout_s"} as JSON, and answers each with a line: the first test that fails, empty
if all pass. What imports the module is imported anew.
"""

import ast
import contextlib
import gc
import json
import os
import re
import select
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

PACKAGES = ("service", "robot_client", "simulation", "reporting", "training", "export", "tactile_insertion", "tests")
FOLDERS = ("tests/service", "tests/robot_client")
WARM = (  # compiles the physics; no session of onnxruntime, which does not live through a fork
    "tests/service/perception/slip/test_open_gel.py",
    "tests/golden/test_golden.py::test_probes_are_as_recorded",
)
USUAL = ["-x", "--tb=no", "--timeout=100", "-n", "0", "-m", "not slow", "-p", "no:cacheprovider", "--no-header"]
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")  # a fork has none of their threads
FAILED = re.compile(r"^(?:FAILED|ERROR) (tests/.*?)(?: - .*)?$", re.MULTILINE)


class Copy:
    """A copy of the repository with the process whose forks run its tests."""

    def __init__(self, root: Path) -> None:
        self.root = root
        quiet = dict.fromkeys(POOLS, "1") | {"PYTHONPATH": str(root)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.mutants.forked"],
            cwd=root,
            env=os.environ | quiet,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ready(self) -> "Copy":
        """Wait until everything is imported: a file that changes before would be changed for all requests."""
        assert self._process.stdout is not None
        self._process.stdout.readline()
        return self

    def failure(self, module: str, tests: list[str], timeout_s: float) -> str:
        """The first of the tests that fails in this copy as its files are now; empty if all of them pass."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        request = {"module": module, "tests": tests, "timeout_s": timeout_s}
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()
        return str(json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


def importers() -> dict[str, set[str]]:
    """Who imports each module of the loaded packages, by their sources."""
    loaded = {name for name in sys.modules if name.split(".")[0] in PACKAGES}
    by: dict[str, set[str]] = {name: set() for name in loaded}
    for name in loaded:
        file = getattr(sys.modules[name], "__file__", None)
        for node in ast.walk(ast.parse(Path(file).read_text())) if file else ():
            names = (
                [node.module or "", *(f"{node.module}.{one.name}" for one in node.names)]
                if isinstance(node, ast.ImportFrom)
                else [one.name for one in node.names]
                if isinstance(node, ast.Import)
                else []
            )
            for imported in set(names) & loaded:
                by[imported].add(name)
    return by


def forget(module: str, by: dict[str, set[str]]) -> None:
    """Drop a module, its importers, and all tests, so that they are imported again."""
    waiting, gone = [module, *(name for name in by if name.split(".")[0] == "tests")], set[str]()
    while waiting:
        name = waiting.pop()
        if name not in gone:
            gone.add(name)
            waiting += by.get(name, ())
    for name in gone - {"tests"}:
        package, _, last = name.rpartition(".")
        sys.modules.pop(name, None)
        if package in sys.modules:  # else `from package import last` would find the old one
            vars(sys.modules[package]).pop(last, None)


def run(request: dict, output: int, scratch: str, by: dict[str, set[str]]) -> None:
    """In the fork: the tests, their report into a file, and what they leave into a folder."""
    os.setsid()  # a mutant may stop or kill its process group
    os.environ["TMPDIR"], tempfile.tempdir = scratch, None
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.dont_write_bytecode = True
    forget(request["module"].removesuffix(".py").replace("/", "."), by)  # no module: the tests alone
    code = pytest.main([*USUAL, *request["tests"]])
    sys.stdout.flush()
    os._exit(int(code))


def outcome(request: dict, by: dict[str, set[str]]) -> str:
    with tempfile.TemporaryFile() as report, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as scratch:
        child = os.fork()
        if child == 0:
            run(request, report.fileno(), scratch, by)
        waits = os.pidfd_open(child)
        ended, _, _ = select.select([waits], [], [], request["timeout_s"])
        os.close(waits)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not ended:
            return "timeout"
        report.seek(0)
        first = FAILED.search(report.read().decode(errors="replace"))
    code = os.waitstatus_to_exitcode(status)
    return first.group(1) if first else f"exit code {code}" * bool(code)


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # nothing else may answer
    with Path(os.devnull).open("w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        pytest.main(["--collect-only", "-q", "-p", "no:cacheprovider", *FOLDERS])
        pytest.main([*USUAL, "--timeout=0", *WARM])
    by = importers()
    gc.collect()
    gc.freeze()  # a fork that collects garbage would copy all of this
    print(json.dumps("ready"), file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(outcome(json.loads(line), by)), file=answers, flush=True)


if __name__ == "__main__":
    main()
