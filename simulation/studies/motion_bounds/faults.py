"""Faults during a motion of the arm: each one, its injection, and the phases in which it is tried."""

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal
from urllib.request import Request, urlopen

from simulation.cell.children import Child
from simulation.cell.run import Loop
from simulation.studies.motion_bounds.relay import Relay, Way
from simulation.studies.motion_bounds.wall_clock import set_ahead

Phase = Literal["arming", "air", "contact", "deciding", "retracting"]
DESCENT: tuple[Phase, ...] = ("air", "contact")
EVERYWHERE: tuple[Phase, ...] = ("arming", "air", "contact", "deciding", "retracting")


def ask(admin_url: str, path: str, changes: dict[str, Any] | None = None) -> Any:
    """The cell's admin port: read ``path``, or post ``changes`` to it."""
    body = None if changes is None else json.dumps(changes).encode()
    request = Request(f"{admin_url}/{path}", body, {"Content-Type": "application/json"})  # noqa: S310 our own child
    with urlopen(request, timeout=5.0) as answer:  # noqa: S310 the same
        return json.load(answer)


@dataclass(frozen=True, slots=True)
class Bench:
    """One live insertion: its processes, and the network between client and service."""

    loop: Loop
    relay: Relay

    def ask(self, path: str, changes: dict[str, Any] | None = None) -> Any:
        return ask(self.loop.facts["admin_url"], path, changes)


Inject = Callable[[Bench], None]


@dataclass(frozen=True, slots=True)
class Fault:
    """``hides_s``: age of a picture beyond its stamp; inf: from the fault on it shows nothing new.

    ``unstamped``: the cameras never stamped a picture. ``sets_clock``: the processes' wall clocks can be set.
    """

    name: str
    inject: Inject
    phases: tuple[Phase, ...] = DESCENT
    hides_s: float = 0.0
    unstamped: bool = False
    sets_clock: bool = False


def _stopped(who: str, seconds: float) -> Inject:
    def inject(bench: Bench) -> None:
        child: Child = getattr(bench.loop, who)
        os.kill(child.process.pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(child.process.pid, signal.SIGCONT)

    return inject


def _killed(who: str) -> Inject:
    def inject(bench: Bench) -> None:
        child: Child = getattr(bench.loop, who)
        os.kill(child.process.pid, signal.SIGKILL)

    return inject


def _clock(who: str, ahead_s: int) -> Inject:
    return lambda bench: set_ahead(getattr(bench.loop, who).process.pid, ahead_s)


def _link(way: Way, late_s: float = 0.0) -> Inject:
    return lambda bench: bench.relay.misbehave(way, late_s)


def _cameras(*fingers: str, **fault: Any) -> Inject:
    def inject(bench: Bench) -> None:
        bench.ask("faults", {f"camera_{finger}": fault for finger in fingers})

    return inject


BOTH = ("left", "right")
HOUR_S = 3600  # longer than either program waits for or tolerates anything, and what a wrong time zone makes
FAULTS: tuple[Fault, ...] = (
    *(Fault(f"service stopped {s:g} s", _stopped("service", s), EVERYWHERE) for s in (0.2, 1.0, 5.0)),
    *(Fault(f"client stopped {s:g} s", _stopped("client", s), EVERYWHERE) for s in (0.2, 1.0, 5.0)),
    Fault("service killed", _killed("service"), EVERYWHERE),
    Fault("client killed", _killed("client"), EVERYWHERE),
    Fault("link drips one byte at a time", _link("drip"), EVERYWHERE),
    Fault("link half open", _link("half open"), EVERYWHERE),
    Fault("link half open to the client", _link("half open to client")),
    Fault("link reset", _link("reset")),
    *(Fault(f"link {ms} ms late", _link("late", ms / 1e3)) for ms in (100, 200, 300)),
    Fault("cameras stalled", _cameras(*BOTH, stall=True)),
    Fault("left camera stalled", _cameras("left", stall=True)),
    Fault("cameras frozen", _cameras(*BOTH, duplicate=True)),
    Fault("right camera frozen", _cameras("right", duplicate=True)),
    Fault("cameras black", _cameras(*BOTH, black=True)),
    Fault("left camera black", _cameras("left", black=True)),
    Fault("cameras cut", _cameras(*BOTH, disconnect=True)),
    Fault("cameras send garbage", _cameras(*BOTH, garbage_next=10_000)),
    Fault("cameras lose 9 of 10 frames", _cameras(*BOTH, drop_share=0.9)),
    *(Fault(f"cameras {ms} ms late", _cameras(*BOTH, delay_ms=ms)) for ms in (100, 200, 300)),
    Fault("left camera frozen, with noise", _cameras("left", frozen_noise=True)),
    Fault("cameras frozen, with noise", _cameras(*BOTH, frozen_noise=True), hides_s=float("inf")),
    *(
        Fault(
            f"cameras {ms} ms late, unstamped",
            _cameras(*BOTH, delay_ms=ms, unstamped=True),
            hides_s=ms / 1e3,
            unstamped=True,
        )
        for ms in (100, 200, 300)
    ),
    Fault("cameras cease to stamp, 300 ms late", _cameras(*BOTH, delay_ms=300, unstamped=True), hides_s=0.3),
    *(
        Fault(f"{who} wall clock set {way} by 1 h", _clock(who, ahead_s), sets_clock=True)
        for who in ("service", "client")
        for way, ahead_s in (("forward", HOUR_S), ("back", -HOUR_S))
    ),
)
