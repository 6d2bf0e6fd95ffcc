"""One client of the soak: it hears every message, and dies at any of them."""

import contextlib
import random
import socket
import struct
import time
from collections import Counter
from dataclasses import dataclass, field

from websockets.sync.client import ClientConnection, connect

from service.contract import wire
from tests.service.client import CELL
from tests.service.mjpeg import FakeFinger
from tests.service.process import ServiceProcess

ANSWER_S = 60.0  # the machine may be busy with other things
LINK = {"compression": None, "max_size": None, "open_timeout": ANSWER_S}


class Killed(Exception):  # noqa: N818 - an event of the story, no error
    """The client was killed here, by the dice."""


@dataclass
class Story:
    """One insertion of a client that may be killed at any message."""

    service: ServiceProcess
    fingers: tuple[FakeFinger, FakeFinger]
    id: str
    rng: random.Random
    kill_share: float
    counts: Counter[str]
    wrong: list[str]
    attempt: int = 0
    decided: bool = True
    corrections: int = 0
    finished: wire.Finished | None = None
    opened: bool = False
    link: ClientConnection | None = None
    links: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)

    def connect(self) -> None:
        url = self.service.url("/v1/insertion", "ws")
        self.link = self.links.enter_context(connect(url, additional_headers=self.service.bearer, **LINK))
        self.send(wire.ClientHello(insertion_id=self.id, client="soak", purpose="probe"))
        self.until({"hello"})
        self.opened = True

    def send(self, message: object) -> None:
        if self.rng.random() < self.kill_share:
            self.kill()
        self.link.send(message.model_dump_json())

    def kill(self) -> None:
        """The process dies: the kernel resets its connection, without a goodbye."""
        self.link.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.link.socket.close()
        self.counts["clients killed"] += 1
        raise Killed

    def until(self, kinds: set[str]) -> object:
        deadline = time.monotonic() + ANSWER_S
        while True:
            message = wire.parse_service(self.link.recv(max(0.01, deadline - time.monotonic())))
            self.counts[f"message {message.type}"] += 1
            self.check(message)
            if message.type in kinds:
                return message
            if isinstance(message, wire.Fault):
                self.counts[f"fault {message.code}"] += 1
                if message.fatal:
                    raise ConnectionError(message.code)
            if isinstance(message, wire.Refused):
                raise ConnectionError(message.reason)

    def check(self, message: object) -> None:
        """No message may arrive for another insertion or attempt."""
        number = getattr(message, "attempt", self.attempt)
        if message.insertion_id != self.id or number != self.attempt:
            self.wrong.append(f"{self.id} attempt {self.attempt} got {message.model_dump_json()[:300]}")

    def tell(self) -> None:
        self.connect()
        attempts = self.rng.randrange(1, 5)
        while self.attempt < attempts or not self.decided:
            self.probe()
        self.arm()
        self.send(wire.Stopped(insertion_id=self.id, attempt=self.attempt, depth_mm=25.0, outcome="inserted"))
        self.finished = self.until({"finished"})

    def arm(self) -> None:
        for finger in self.fingers:
            finger.probe_started = None
        time.sleep(0.15)
        if self.decided:
            self.attempt, self.decided = self.attempt + 1, False
        self.send(wire.Arm(insertion_id=self.id, attempt=self.attempt, **CELL, expected_depth_mm=25.0))
        self.until({"armed"})

    def probe(self) -> None:
        self.arm()
        started = time.monotonic()
        for finger in self.fingers:
            finger.probe(started)
        self.send(wire.Descending(insertion_id=self.id, attempt=self.attempt))
        self.until({"slip", "fault"})
        stopped = wire.Stopped(insertion_id=self.id, attempt=self.attempt, depth_mm=3.0, outcome="blocked")
        self.send(stopped)
        answer = self.until({"correction", "no_decision"})
        if self.rng.random() < 0.2:  # said twice, answered twice, with the same
            self.send(stopped)
            again = self.until({"correction", "no_decision"})
            if again != answer:
                self.wrong.append(f"{self.id}: a repeated stop changed the answer")
        self.decided = True
        self.corrections += answer.type == "correction"
