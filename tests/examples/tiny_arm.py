"""An arm that is only its clock: it descends for as long as it may, also while its controller is stopped."""

import threading
import time
from collections.abc import Callable

LAG_S = 0.02


class TinyArm:
    """The arm and gripper of examples/cell_controller.py; ``trouble`` is called at ``trouble_mm`` of its descent.

    ``touch`` is called at ``contact_mm`` unless the arm was moved there by a correction.
    """

    def __init__(
        self,
        trouble: Callable[[], object] | None = None,
        touch: Callable[[], object] | None = None,
        trouble_mm: float = 0.4,
        contact_mm: float = 0.8,
    ) -> None:
        self.moves: list[tuple[float, float]] = []
        self.grasped = self.retracted = self.stopped = 0
        self.widths_mm = [49.6]
        self.broken_mm: float | None = None
        self.refuses = ""
        self.on_grasp: Callable[[], object] = lambda: None
        self._trouble, self._touch = trouble, touch
        self._trouble_mm, self._contact_mm = trouble_mm, contact_mm
        self._from_s = self._until_s = 0.0
        self._speed_mm_s = self._to_mm = 0.0

    def grasp(self) -> None:
        self.grasped += 1
        self.on_grasp()

    def width_mm(self) -> float | None:
        return self.widths_mm.pop(0) if len(self.widths_mm) > 1 else self.widths_mm[0]

    def descend(self, depth_mm: float, speed_mm_s: float, for_s: float) -> None:
        if self.refuses:
            raise RuntimeError(self.refuses)
        self._speed_mm_s, self._to_mm = speed_mm_s, depth_mm
        self._from_s = time.monotonic()
        self._until_s = self._from_s + for_s
        if self._trouble:
            self._at(self._trouble_mm, self._break)
        elif self._touch and not self.moves:
            self._at(self._contact_mm, self._touch)

    def go_on(self, for_s: float) -> None:
        now_s = time.monotonic()
        if now_s < self._until_s:
            self._until_s = now_s + for_s

    def _at(self, depth_mm: float, call: Callable[[], object]) -> None:
        threading.Timer(depth_mm / self._speed_mm_s, call).start()

    def _break(self) -> None:
        self.broken_mm = self.depth_mm()
        if self._trouble:
            self._trouble()

    def descending(self) -> bool:
        return time.monotonic() < self._until_s and self.depth_mm() < self._to_mm

    def stop(self) -> None:
        self.stopped += 1
        self._until_s = min(self._until_s, time.monotonic() + LAG_S)
        time.sleep(LAG_S)

    def depth_mm(self) -> float:
        moving_s = max(0.0, min(time.monotonic(), self._until_s) - self._from_s)
        return min(self._to_mm, self._speed_mm_s * moving_s)

    def retract(self) -> None:
        self.retracted += 1
        self._from_s = self._until_s = 0.0

    def move_by(self, dx_mm: float, dtheta_deg: float) -> None:
        self.moves.append((dx_mm, dtheta_deg))
