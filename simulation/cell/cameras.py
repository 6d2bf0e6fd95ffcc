"""Turn exposures into camera streams: each finger renders and encodes on its own thread, newest exposure first."""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulation.cell.emulators.camera import CameraEmulator, Shot, encode_jpeg
from simulation.cell.world import Exposure, Gel

Image = NDArray[np.uint8]
Draw = Callable[[Gel, int, Gel], Image]
"""(gel [rows, columns, 3], frame seed, gel one frame earlier) -> raw BGR image uint8 [h, w, 3]."""


class CameraFeed:
    """One finger's sensor: draws the newest exposure and publishes the shot on the event loop."""

    def __init__(self, camera: CameraEmulator, index: int, draw: Draw, loop: asyncio.AbstractEventLoop) -> None:
        self.error: BaseException | None = None
        self.drawn_ns = 0  # capture time of the last picture that shows the gel, not a repeat
        self._camera = camera
        self._index = index
        self._draw = draw
        self._loop = loop
        self._waiting: Exposure | None = None
        self._frozen: Image | None = None  # the last picture drawn
        self._wake = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name=f"camera-{camera.finger}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        with self._wake:
            self._stopped = True
            self._wake.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def expose(self, exposure: Exposure) -> None:
        """Take an exposure; an exposure still waiting is dropped (the sensor is overrun)."""
        with self._wake:
            self._waiting = exposure
            self._wake.notify()

    def shoot(self, exposure: Exposure) -> Shot:
        """Draw and encode one exposure, with this camera's faults."""
        faults = self._camera.faults
        gel, previous = exposure.gel[self._index], exposure.previous[self._index]
        if not faults.frozen_noise or self._frozen is None:
            self._frozen = self._draw(gel, 2 * exposure.seq + self._index, previous)
            self.drawn_ns = exposure.captured_ns
        pixels = self._frozen
        if faults.frozen_noise:
            noise = np.random.default_rng(exposure.seq).integers(-2, 3, pixels.shape)
            pixels = np.clip(pixels + noise, 0, 255).astype(np.uint8)
        if faults.black:
            pixels = np.zeros_like(pixels)
        if faults.half_size:
            pixels = np.ascontiguousarray(pixels[::2, ::2])
        return Shot(encode_jpeg(pixels), exposure.seq, exposure.captured_ns)

    def _next(self) -> Exposure | None:
        with self._wake:
            self._wake.wait_for(lambda: self._stopped or self._waiting is not None)
            exposure, self._waiting = self._waiting, None
            return None if self._stopped else exposure

    def _run(self) -> None:
        try:
            while (exposure := self._next()) is not None:
                if self._camera.watched:
                    asyncio.run_coroutine_threadsafe(self._camera.publish(self.shoot(exposure)), self._loop)
        except BaseException as error:  # reported by the cell's main, which ends
            self.error = error


def failure(*parts: Any) -> BaseException | None:
    """The first error raised in one of the threads."""
    return next((part.error for part in parts if part.error is not None), None)
