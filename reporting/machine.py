"""The machine and code version behind a report, and the cost of a call there."""

import os
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def cpu_name() -> str:
    """Model name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "unknown"


def machine() -> dict[str, Any]:
    """Processor, cores, and the load averages over 1, 5 and 15 minutes."""
    return {"cpu": cpu_name(), "cores": os.cpu_count(), "load": list(os.getloadavg())}


def commit() -> str:
    """Commit of this code, with ``+dirty`` if its files have changed; ``unknown`` for an installed package.

    The folder that a command is run in may be someone else's repository, and an environment may lie in one.
    """
    asked = (
        ("ls-files", "--error-unmatch", Path(__file__).name),
        ("rev-parse", "HEAD"),
        ("status", "--porcelain", "--untracked-files=no"),
    )
    try:
        _, head, changes = (
            subprocess.run(
                ["git", *words], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
            ).stdout
            for words in asked
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.strip() + ("+dirty" if changes.strip() else "")


def best_cpu_ms(call: Callable[[], Any], repeats: int) -> float:
    """Shortest processor time of ``repeats`` calls, ms: disturbances only make a call longer."""

    def once() -> float:
        begun = time.process_time()
        call()
        return 1e3 * (time.process_time() - begun)

    return min(once() for _ in range(repeats))
