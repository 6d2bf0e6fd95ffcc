"""A decision service for the tests that knows the truth: it looks where the emulated arm is."""

import asyncio
import time
from dataclasses import dataclass, field

from websockets.exceptions import ConnectionClosed

from service.contract import wire
from service.contract.replies import beat, clock, ending
from simulation.cell.emulators.abb.cabinet import Cabinet

FRAME_S = 0.03
CONTACT_MM, CLEARANCE_MM, CLEARANCE_DEG = 6.0, 2.5, 3.5
LIMITS = wire.Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=250.0)


@dataclass
class TruthfulService:
    """Speaks the wire protocol; watches the emulated arm for contact and answers with 0.7 times the true error.

    ``on_message`` sees each client message first and may return replies of its own instead (None: as usual).
    """

    cabinet: Cabinet
    approach_z_mm: float = 35.0
    share: float = 0.7
    received: list = field(default_factory=list)
    slips_ns: list = field(default_factory=list)
    on_message: object = None
    delays_s: dict = field(default_factory=dict)
    mute: bool = False
    silent_heartbeat: bool = False
    sees: bool = True
    offset: tuple = (0.0, 0.0)
    connection: object = None
    _attempt: int = 0
    _watching: bool = False

    @property
    def error(self):
        pose = self.cabinet.arm.pose
        return pose.position_mm[0] + self.offset[0], pose.yaw_deg + self.offset[1]

    async def handle(self, connection):
        self.connection = connection
        watcher = asyncio.create_task(self._watch())
        try:
            async for text in connection:
                message = wire.parse_client(text)
                if not isinstance(message, wire.ClientHeartbeat | wire.Telemetry | wire.Episode):
                    self.received.append(message)
                await asyncio.sleep(self.delays_s.get(message.type, 0.0))
                replies = self.on_message(message) if self.on_message else None
                for reply in self._answer(message) if replies is None else replies:
                    await self.say(reply)
        except (ConnectionClosed, OSError):
            pass  # the client or the test cut the connection
        finally:
            watcher.cancel()

    async def say(self, reply):
        if not self.mute and self.connection is not None:
            await self.connection.send(reply if isinstance(reply, str | bytes) else reply.model_dump_json())

    def slip(self, **changes):
        values = {"attempt": self._attempt, "finger": "left", "frame_seq": 1, "captured_ns": 1, "age_ms": 5.0}
        return wire.Slip(insertion_id=self.insertion_id, score=8.0, reason="test", **{**values, **changes})

    def correction(self, attempt, **changes):
        x, theta = self.error
        values = {"dx_mm": -self.share * x, "dtheta_deg": -self.share * theta}
        return wire.Correction(
            insertion_id=self.insertion_id,
            attempt=attempt,
            class_probabilities={"5": 0.9, "2": 0.1},
            estimate=wire.Estimate(dx_mm=x, dtheta_deg=theta),
            confidence=0.9,
            controller="heuristic",
            reason="truth",
            latency_ms={"infer": 2.0},
            **{**values, **changes},
        )

    def hello(self, **changes):
        values = {"models": (), "cameras": (), "controller": "heuristic", "limits": LIMITS}
        return wire.ServiceHello(insertion_id=self.insertion_id, **{**values, **changes})

    def watching(self, **changes):
        now_ns = time.monotonic_ns()
        values = {"attempt": self._attempt, "frame_captured_ns": now_ns, "judged_ns": now_ns}
        return wire.Watching(insertion_id=self.insertion_id, **{**values, **changes})

    async def _watch(self):
        watched_s = 0.0
        while True:
            await asyncio.sleep(0.002)
            if self._watching and self.sees and time.monotonic() - watched_s > FRAME_S:
                watched_s = time.monotonic()
                await self.say(self.watching())
            x, theta = self.error
            depth = self.approach_z_mm - self.cabinet.arm.pose.position_mm[2]
            blocked = abs(x) > CLEARANCE_MM or abs(theta) > CLEARANCE_DEG
            if self._watching and blocked and depth >= CONTACT_MM:
                self._watching = False
                self.slips_ns.append(time.monotonic_ns())
                await self.say(self.slip())

    def _answer(self, message):
        replies = []
        name = {"insertion_id": message.insertion_id}
        self.insertion_id = message.insertion_id
        match message:
            case wire.ClientHello():
                self._attempt, self._watching = 0, False
                replies = [self.hello(clock=clock(message, time.monotonic_ns()))]
            case wire.ClientHeartbeat() if not self.silent_heartbeat:
                replies = [beat(message, time.monotonic_ns(), 10.0)]
            case wire.LearnOpen():
                replies = [wire.OpenLearnt(**name)]
            case wire.Arm():
                self._attempt, self._watching = message.attempt, True
                now_ns = time.monotonic_ns()
                replies = [wire.Armed(**name, attempt=message.attempt, reference_seq=1, frame_captured_ns=now_ns)]
            case wire.Stopped(outcome="blocked"):
                self._watching = False
                replies = [self.correction(message.attempt)]
            case wire.Stopped():
                self._watching = False
                replies = [wire.Finished(**name, outcome="inserted", attempts=message.attempt)]
            case wire.Abort():
                self._watching = False
                replies = [wire.Finished(**name, outcome=ending(message.cause), attempts=self._attempt)]
        return replies
