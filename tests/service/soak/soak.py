"""`python -m tests.service.soak.soak --minutes 30`: insertions for half an hour while everything goes wrong.

Clients are killed, cameras cut, and every path of the service's port gets garbage. Looked for: leaks (slope of the
resident memory), a correction for another attempt or insertion, a finished insertion whose recording is not there.
Writes docs/soak.md and .json; exit code 1 if any of these was found.
"""

import argparse
import contextlib
import json
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from websockets.exceptions import WebSocketException

from reporting.machine import machine
from service.recordings.reader import Recording, RecordingError
from tests.service import drawn
from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess, service_process
from tests.service.soak.memory import Slope, slope
from tests.service.soak.story import Killed, Story
from tests.service.trouble import Cuts, Garbage, Trouble, server_errors

SAMPLE_S = 5.0
REST_S = 0.3  # from `finished` until an insertion's memory is released, on an idle machine
REST_READINGS, CLOSED_S = 3, 5.0


@dataclass
class Soak:
    """The whole run and its findings."""

    service: ServiceProcess
    fingers: tuple[FakeFinger, FakeFinger]
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    abandoned: list[str] = field(default_factory=list)
    samples: list[tuple[float, float, int, int]] = field(default_factory=list)
    at_rest: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)
    _stop: threading.Event = field(default_factory=threading.Event)

    def run(self, minutes: float, seed: int) -> None:
        rng = random.Random(seed)
        watcher = threading.Thread(target=self._watch, daemon=True)
        watcher.start()
        number = 0
        while time.monotonic() < self.started + 60 * minutes and self.service.process.poll() is None:
            number += 1
            share = rng.choice((0.0, 0.0, 0.05))
            self._tell(Story(self.service, self.fingers, f"soak-{number}", rng, share, self.counts, self.wrong))
            self._rest()
            if number % 20 == 0:
                print(f"{number} insertions, {self.samples[-1][1]:.0f} MB, {dict(self.counts)}", flush=True)
        self._stop.set()
        watcher.join(10)

    def _tell(self, story: Story) -> None:
        """An insertion; a killed client comes back half of the time and takes it up again."""
        self.counts["insertions"] += 1
        while True:
            try:
                story.tell()
            except Killed:
                if story.rng.random() < 0.5:
                    self.counts["clients that came back"] += 1
                    continue
                self.abandoned += [story.id] if story.opened else []
                return
            except (ConnectionError, WebSocketException, TimeoutError) as error:
                self.counts[f"given up: {type(error).__name__} {error}"[:60]] += 1
                if str(error) == "busy":  # the client before is given up in a moment
                    time.sleep(0.5)
                    continue
                self.abandoned += [story.id] if story.opened else []
                return
            finally:
                with contextlib.suppress(Exception):
                    story.links.close()
            self._verify(story)
            return

    def _rest(self) -> None:
        """What the service holds while nothing is under way: the least of three readings within a second or so.

        A reading may catch what an insertion held before it is given back. There is none if an abandoned insertion is
        still under way.
        """
        readings, until = [], time.monotonic() + CLOSED_S
        while any(self.service.recordings.glob("*/*.part")) and time.monotonic() < until:
            time.sleep(REST_S)  # a recording that is being closed is no rest either
        with contextlib.suppress(httpx.HTTPError, OSError):
            for _ in range(REST_READINGS):
                time.sleep(REST_S)
                readings.append(self.service.memory_mb())
            if httpx.get(self.service.url("/v1/insertions"), timeout=60).json()["active"] is None:
                least = min(readings, key=lambda reading: reading["all"])
                self.at_rest.append((time.monotonic() - self.started, least))

    def _verify(self, story: Story) -> None:
        """Every finished insertion is on the disk, complete, with every correction that the client received."""
        path = Path(story.finished.recording or "nowhere")
        try:
            recording = Recording(path)
            kinds = [e.json()["message"]["type"] for e in recording.of("/messages")]
            summary = json.loads((path.parent / "summary.json").read_text())
        except (OSError, ValueError, RecordingError) as error:
            self.lost.append(f"{story.id}: {error}")
            return
        whole = recording.complete and summary["outcome"] == story.finished.outcome and kinds.count("finished") == 1
        if not whole or kinds.count("correction") < story.corrections:
            self.lost.append(f"{story.id}: {summary}, {Counter(kinds)}")
        self.counts["finished recordings verified"] += 1
        folder = self.service.url(f"/v1/recordings/{path.parent.name}")
        httpx.delete(folder, headers=self.service.bearer, timeout=60).raise_for_status()

    def verify_abandoned(self) -> None:
        """Insertions that no client finished are closed, too: by a takeover, a silence, or the end of the service."""
        for insertion in self.abandoned:
            folders = list(self.service.recordings.glob(f"*_{insertion}"))
            if len(folders) != 1 or not (folders[0] / "insertion.mcap").is_file():
                self.lost.append(f"{insertion}: {[sorted(p.name for p in f.iterdir()) for f in folders]}")
        self.counts["abandoned recordings verified"] = len(self.abandoned)

    def _watch(self) -> None:
        while not self._stop.wait(SAMPLE_S):
            with contextlib.suppress(OSError):
                now = time.monotonic() - self.started
                self.samples.append(
                    (now, self.service.memory_mb()["all"], self.service.threads_n(), self.service.files_n())
                )

    def slope(self, kind: str) -> Slope:
        """Growth of resident memory at rest: ``all``, ``own`` (heaps) or ``files`` (libraries)."""
        at_s, memory = zip(*self.at_rest, strict=True) if self.at_rest else ((), ())
        return slope(list(at_s), [m[kind] for m in memory], self.samples[-1][0] if self.samples else 0.0)


def arguments(given: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate-hz", type=float, default=15.0, help="of each camera; lower it on a busy machine")
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of the networks that decide")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder for soak.md and soak.json")
    return parser.parse_args(given)


def main() -> int:
    from tests.service.soak.report import report

    given = arguments()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the service is asked to stop as well
    fingers = FakeFinger("left", given.rate_hz), FakeFinger("right", given.rate_hz)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        drawn.calibration().save(root / "calibration.toml")
        options = ["--camera-left", fingers[0].url, "--camera-right", fingers[1].url, "--log-json", "true"]
        options += ["--calibration", str(root / "calibration.toml"), "--max-frame-age-ms", "5000"]
        options += ["--reference-timeout-s", "10", "--frames-timeout-s", "10", "--decision-timeout-s", "30"]
        with service_process(given.models, root / "recordings", *options) as service:
            soak, garbage = Soak(service, fingers), Garbage(service)
            troubles = [
                Trouble(0.7, given.seed + 1, garbage),
                Trouble(30.0, given.seed + 2, Cuts(fingers)),
            ]
            soak.run(given.minutes, given.seed)
            for trouble in troubles:
                trouble.close()
            garbage.close()
            alive = service.process.poll() is None
        soak.verify_abandoned()
        done = sum((trouble.done for trouble in troubles), Counter())
        errors = [*(e for trouble in troubles for e in trouble.errors), *server_errors(service)]
        code = service.process.returncode if alive else f"died: {service.log[-5:]}"
    for finger in fingers:
        finger.close()
    return report(soak, done, errors, code, given, machine())


if __name__ == "__main__":
    sys.exit(main())
