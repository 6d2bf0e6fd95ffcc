"""How far the arm goes on down after the capture of the newest frame that was judged, in lock step."""

from typing import Any

from service.contract import wire


class Unseen:
    """Follows the arm's height from frame to frame, and which frames the service says it judged. Lengths in mm."""

    def __init__(self) -> None:
        self.most_mm = 0.0
        self._heights: dict[int, float] = {}
        self._answered_mm: float | None = None

    def frame(self, captured_ns: int, height_mm: float) -> None:
        """The arm was at this height when these frames were taken."""
        self._heights[captured_ns] = height_mm
        if self._answered_mm is not None:
            self.most_mm = max(self.most_mm, self._answered_mm - height_mm)

    def heard(self, message: Any) -> None:
        """What the service said; `armed`, `watching` and `slip` name the frame that they rest on."""
        match message:
            case wire.Armed() | wire.Watching():
                captured_ns = message.frame_captured_ns
            case wire.Slip():
                captured_ns = message.captured_ns
            case _:
                return
        if captured_ns in self._heights:  # else a newer one was judged meanwhile
            self._answered_mm = self._heights[captured_ns]
            self._heights = {stamp: height for stamp, height in self._heights.items() if stamp >= captured_ns}
