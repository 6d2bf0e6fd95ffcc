"""What a replayed clip looked like: a strip of its first events over a timeline, and on request the annotated video."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.annotate import annotate, timeline
from service.perception.markers.field import MarkerField
from service.perception.slip.detector import SlipState

TILES_A_ROW, MAX_TILES = 4, 12
TILE_WIDTH_PX = 300


class ReplayPicture:
    """Collects a clip's events as it plays; `close` writes BASE.png, the video BASE.avi grows frame by frame."""

    def __init__(self, base: Path, rate_hz: float, *, video: bool) -> None:
        base.parent.mkdir(parents=True, exist_ok=True)
        self._picture, self._video = base.with_suffix(".png"), base.with_suffix(".avi") if video else None
        self._rate_hz = rate_hz
        self._writer: cv2.VideoWriter | None = None
        self._tiles: list[NDArray[np.uint8]] = []
        self._last = ""

    def add(self, image: NDArray[np.uint8], field: MarkerField, state: SlipState) -> None:
        """One frame, uint8 [height, width, 3]; raises OSError if the video cannot be written."""
        event = state.state != self._last and len(self._tiles) < MAX_TILES
        self._last = state.state
        if not event and self._video is None:
            return
        canvas = annotate(image, field, state, state.captured_ns * 1e-9)
        if event:
            height = round(canvas.shape[0] * TILE_WIDTH_PX / canvas.shape[1])
            tile = cv2.resize(canvas, (TILE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            self._tiles.append(np.asarray(tile, np.uint8))
        if self._video is not None:
            self._film(canvas, self._video)

    def close(self, states: Sequence[SlipState]) -> list[Path]:
        """Write the picture; returns the files written."""
        written = [self._picture]
        if self._writer is not None and self._video is not None:
            self._writer.release()
            written.append(self._video)
        times_s = [state.captured_ns * 1e-9 for state in states]
        parts = [*self._rows(), timeline(times_s, states, width=TILES_A_ROW * TILE_WIDTH_PX)]
        if not cv2.imwrite(str(self._picture), np.vstack(parts)):
            raise OSError(f"cannot write {self._picture}")
        return written

    def _rows(self) -> list[NDArray[np.uint8]]:
        rows = []
        for begin in range(0, len(self._tiles), TILES_A_ROW):
            tiles = self._tiles[begin : begin + TILES_A_ROW]
            blank = np.full_like(tiles[0], 255)
            rows.append(np.asarray(np.hstack([*tiles, *[blank] * (TILES_A_ROW - len(tiles))]), np.uint8))
        return rows

    def _film(self, canvas: NDArray[np.uint8], path: Path) -> None:
        if self._writer is None:
            codec = cv2.VideoWriter.fourcc(*"MJPG")
            self._writer = cv2.VideoWriter(str(path), codec, self._rate_hz, (canvas.shape[1], canvas.shape[0]))
            if not self._writer.isOpened():
                raise OSError(f"cannot write {path}")
        self._writer.write(canvas)
