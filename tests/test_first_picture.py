"""Both fingers are in a browser within ten seconds of `demo`, on an otherwise idle machine."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.service.web.test_dashboard import CHROMIUM, FLAGS, colours, playwright

ROOT = Path(__file__).parents[1]
MOST_S = 10.0
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt-get install chromium)"),
]


def until_served(url: str, process: subprocess.Popen[str]) -> None:
    while process.poll() is None:
        try:
            httpx.get(url, timeout=1.0)
            return
        except httpx.TransportError:
            time.sleep(0.05)
    raise AssertionError("the demonstration has ended")


def pictures_after_s(page, folder: Path, port: int) -> dict[str, float]:
    """When each finger was first drawn, counted from the command, s."""
    command = [sys.executable, "-m", "simulation", "demo", "--out", str(folder), "--port", str(port)]
    began, pictures_s = time.monotonic(), {}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, text=True) as process:
        try:
            until_served(url := f"http://127.0.0.1:{port}/", process)
            page.goto(url)
            while len(pictures_s) < 2:
                for finger in {"left", "right"} - set(pictures_s):
                    if colours(page, finger) > 50:
                        pictures_s[finger] = time.monotonic() - began
                page.wait_for_timeout(20)
        finally:
            process.send_signal(signal.SIGINT)
    return pictures_s


def test_the_first_pictures_are_there_within_ten_seconds(tmp_path):
    """The first of two starts compiles the physics if necessary, and is not counted."""
    with playwright.sync_playwright() as running:
        page = running.chromium.launch(executable_path=CHROMIUM, args=FLAGS).new_page()
        for folder, port in (("compiles", 8101), ("counts", 8102)):
            load = max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))
            pictures_s = pictures_after_s(page, tmp_path / folder, port)
    print(f"first pictures after {pictures_s} s, at {load:.1f} times the load that this machine bears")
    assert max(pictures_s.values()) <= MOST_S * load
