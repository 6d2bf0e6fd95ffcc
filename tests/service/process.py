"""The service as a process of its own, as operations run it: for kill -9, memory and load."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from service.contract.token import TOKEN_FILE, read_token

START_TIMEOUT_S = 120.0


@dataclass
class ServiceProcess:
    """`python -m service run` with its port and its standard error."""

    process: subprocess.Popen[str]
    port: int
    recordings: Path
    log: list[str] = field(default_factory=list)

    def url(self, path: str, scheme: str = "http") -> str:
        return f"{scheme}://127.0.0.1:{self.port}{path}"

    @property
    def token(self) -> str:
        """The token for driving and administration, as a client of this machine finds it."""
        return read_token(self.recordings.parent / "state" / TOKEN_FILE)

    @property
    def bearer(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.token}"}

    def kill(self) -> None:
        """As the kernel kills: no handler, no flush."""
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait(10)

    def memory_mb(self) -> dict[str, float]:
        """Resident memory: ``all``, of which ``own`` (heaps, stacks) and ``files`` (libraries, mapped files)."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        names = {"all": "VmRSS", "own": "RssAnon", "files": "RssFile"}
        return {kind: int(re.search(rf"{name}:\s+(\d+)", status)[1]) / 1024 for kind, name in names.items()}

    def threads_n(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/task").iterdir()))

    def files_n(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))

    def cpu_s(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextlib.contextmanager
def service_process(models: Path, recordings: Path, *options: str) -> Iterator[ServiceProcess]:
    """A running service; it is asked to stop at the end, unless it has already ended."""
    command = [sys.executable, "-m", "service", "run", "--models", str(models), "--recordings", str(recordings)]
    command += ["--state", str(recordings.parent / "state")]
    process = subprocess.Popen(
        [*command, "--port", "0", "--camera-wait-s", "30", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    log: list[str] = []
    reader = threading.Thread(target=lambda: log.extend(process.stderr), daemon=True)
    reader.start()
    watchdog = threading.Timer(START_TIMEOUT_S, process.kill)
    watchdog.start()
    line = process.stdout.readline()
    watchdog.cancel()
    ready = re.search(r"service ready at https?://[^ ]+:(\d+)/", line)
    if ready is None:
        process.wait(10)
        reader.join(5)
        raise RuntimeError(f"the service did not start: {line}{''.join(log)}")
    try:
        yield ServiceProcess(process, int(ready[1]), recordings, log)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
        if process.poll() is None:
            process.kill()
            process.wait(10)
        process.stdout.close()
        reader.join(5)
        process.stderr.close()
