"""EGM on the robot's side: the controller sends its state first, at 250 Hz, to the configured guide; the guide answers.

Bytes come from ``robot_client.robots.abb_egm.codec``. A guide's message counts only if it parses, is finite and carries
a unit quaternion. A non-finite target ends guidance: the arm brakes and holds.
"""

import asyncio
import random
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

from robot_client.insertion.geometry import Pose as WirePose
from robot_client.insertion.geometry import normalised
from robot_client.robots.abb_egm.codec import RobotState, decode_guidance, encode_robot
from simulation.cell.emulators.abb.cabinet import Cabinet
from simulation.cell.emulators.abb.frames import CellFrames
from simulation.cell.emulators.abb.motion import Pose
from simulation.cell.emulators.net import HOST

CYCLE_S = 0.004
_CATCH_UP_CYCLES = 3
_FAREWELL_CYCLES = 12  # the controller reports the stopped state for some 50 ms before the stream ends


@dataclass(slots=True)
class EgmCounters:
    """Counts of what went over the wire, for tests."""

    received: int = 0
    refused: int = 0
    lost_cycles: int = 0


def _to_wire(pose: Pose) -> WirePose:
    return WirePose(*pose.position_mm, *pose.quaternion)


class EgmEmulator(asyncio.DatagramProtocol):
    """The UDP side of the cabinet, and the controller's clock, in cycles of exactly 4 ms as on the real one.

    If the machine is too busy to serve a cycle, the next ones follow at once. If it falls more than a few cycles
    behind, the lost ones are skipped and counted, as if their datagrams had been lost. The arm moves by the clock, not
    by the count.
    """

    def __init__(self, cabinet: Cabinet, frames: CellFrames, guide_port: int) -> None:
        self.cabinet = cabinet
        self.frames = frames
        self.counters = EgmCounters()
        self.on_cycle: list[Callable[[], None]] = []
        self._guide = (HOST, guide_port)
        self._sequence = 0
        self._farewell = 0
        self._frozen = b""
        self._random = random.Random(0)
        self._transport: asyncio.DatagramTransport | None = None
        self._clock: asyncio.Task[None] | None = None
        self.controller_s = 0.0

    async def start(self, sock: socket.socket) -> None:
        """Take the bound socket and start the 4 ms clock."""
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.create_datagram_endpoint(lambda: self, sock=sock)
        self._clock = asyncio.create_task(self._run())

    async def stop(self) -> None:
        """Stop the clock and close the socket."""
        if self._clock is not None:
            self._clock.cancel()
            await asyncio.gather(self._clock, return_exceptions=True)
        if self._transport is not None:
            self._transport.close()

    async def _run(self) -> None:
        due_s = time.monotonic()
        while True:
            self.controller_s += CYCLE_S
            self.cabinet.advance(self.controller_s)
            for callback in self.on_cycle:
                callback()
            self._report()
            due_s += CYCLE_S
            late_s = time.monotonic() - due_s
            if late_s > _CATCH_UP_CYCLES * CYCLE_S:
                lost = int(late_s / CYCLE_S)
                self.counters.lost_cycles += lost
                self.controller_s += lost * CYCLE_S
                due_s += lost * CYCLE_S
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    # ---- robot to guide ---------------------------------------------------------------------------------------

    def _report(self) -> None:
        if self.cabinet.egm != "off":
            self._farewell = _FAREWELL_CYCLES
        elif self._farewell:
            self._farewell -= 1
        else:
            self._sequence = 0
            return
        faults = self.cabinet.board.faults.egm
        message = self._message()
        if faults.frozen:
            message = self._frozen = self._frozen or message
        else:
            self._frozen = b""
        if faults.garbage_next:
            faults.garbage_next -= 1
            message = self._random.randbytes(len(message))
        if faults.silent or self._random.random() < faults.drop_share:
            return
        self._after_delay(lambda: self._send(message))

    def _after_delay(self, action: Callable[[], None]) -> None:
        delay_ms = self.cabinet.board.faults.egm.delay_ms
        if delay_ms:
            asyncio.get_running_loop().call_later(delay_ms / 1000.0, action)
        else:
            action()

    def _send(self, message: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.sendto(message, self._guide)

    def _message(self) -> bytes:
        cabinet, arm = self.cabinet, self.cabinet.arm
        running = cabinet.egm != "off"
        state = RobotState(
            sequence=self._sequence,
            time_ms=round(self.controller_s * 1000.0),
            feedback=_to_wire(arm.pose),
            planned=_to_wire(arm.target if running else arm.pose),
            joints_deg=self.frames.joints_deg(arm.pose),
            motors_on=cabinet.motors_on,
            rapid_running=cabinet.running,
            mc_state="running" if running else "stopped",
            converged=arm.at_rest,
        )
        self._sequence += 1
        return encode_robot(state)

    # ---- guide to robot ---------------------------------------------------------------------------------------

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """A datagram arrived; only those of the configured guide's host are read."""
        if addr[0] != HOST or self.cabinet.board.faults.egm.ignore_guide:
            return
        self._after_delay(lambda: self._obey(data))

    def error_received(self, exc: Exception) -> None:
        """No guide listens yet (ICMP unreachable): keep sending, as the controller does."""

    def _obey(self, data: bytes) -> None:
        self.counters.received += 1
        if self.cabinet.egm == "off":
            return
        try:
            pose = decode_guidance(data).pose
            target = None if pose is None else Pose((pose.x_mm, pose.y_mm, pose.z_mm), normalised(pose.quaternion))
        except ValueError as error:
            self.counters.refused += 1
            if "finite" in str(error):
                self.cabinet.guidance_error(str(error))
            return
        if target is None:
            self.cabinet.keep_alive()
            return
        self.cabinet.guide(target)
