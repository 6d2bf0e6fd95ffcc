"""How far the arm descends after the exposure of the newest judged frame, in lock step."""

from typing import Any

from service.contract import wire


class Unseen:
    """Follows the arm's height from frame to frame, and the frames reported as judged. Lengths in mm."""

    def __init__(self) -> None:
        self.most_mm = 0.0
        self._heights: dict[int, float] = {}
        self._answered_mm: float | None = None

    def frame(self, captured_ns: int, exposed_mm: float, height_mm: float) -> None:
        """Record the arm's height at the exposure of frames with this stamp, and its present height."""
        self._heights[captured_ns] = exposed_mm
        if self._answered_mm is not None:
            self.most_mm = max(self.most_mm, self._answered_mm - height_mm)

    def heard(self, message: Any) -> None:
        """Take a message of the service; `armed`, `watching` and `slip` name the frame behind them."""
        match message:
            case wire.Armed() | wire.Watching():
                captured_ns = message.frame_captured_ns
            case wire.Slip():
                captured_ns = message.captured_ns
            case _:
                return
        if captured_ns in self._heights:  # else a newer frame has been judged meanwhile
            self._answered_mm = self._heights[captured_ns]
            self._heights = {stamp: height for stamp, height in self._heights.items() if stamp >= captured_ns}
