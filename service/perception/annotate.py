"""Frames with what perception saw drawn on them, for people."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from service.perception.markers.field import MarkerField
from service.perception.slip.detector import SlipState

_COLOURS = {  # BGR
    "no_contact": (160, 160, 160),
    "grasping": (0, 200, 255),
    "hold": (80, 200, 80),
    "contact": (255, 180, 0),
    "incipient_slip": (0, 80, 255),
    "gross_slip": (0, 0, 255),
    "release": (200, 0, 200),
    "lost": (0, 0, 0),
    "unknown": (120, 120, 120),
}
_SCORE, _RESIDUAL = (180, 90, 0), (90, 150, 60)
_SCALE = 2
_ARROW = 4.0  # arrows are drawn this many times as long as the displacement


def annotate(image: NDArray[np.uint8], field: MarkerField, state: SlipState, time_s: float) -> NDArray[np.uint8]:
    """The frame twice as large with displacement arrows (green sticking, red slipping) and the state on a strip."""
    canvas = cv2.resize(image, None, fx=_SCALE, fy=_SCALE, interpolation=cv2.INTER_LINEAR)
    slipping = state.slipping if state.slipping.shape == field.valid.shape else np.zeros_like(field.valid)
    for at, step, valid, slips in zip(
        field.rest_px.reshape(-1, 2),
        field.displacement_px.reshape(-1, 2),
        field.valid.reshape(-1),
        slipping.reshape(-1),
        strict=True,
    ):
        if not valid:
            continue
        start = np.round((at + step) * _SCALE).astype(int)
        end = np.round((at + (1 + _ARROW) * step) * _SCALE).astype(int)
        colour = (0, 0, 255) if slips else (90, 230, 90)
        cv2.line(canvas, start.tolist(), end.tolist(), colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start.tolist(), 2, colour, -1, cv2.LINE_AA)
    strip = np.zeros((28, canvas.shape[1], 3), np.uint8)
    strip[:, :8] = _COLOURS[state.state]
    text = f"{time_s:7.2f} s  {state.state}  score {state.score:.2f}"
    cv2.putText(strip, text, (16, 19), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(np.vstack([canvas, strip]), np.uint8)


def timeline(times_s: Sequence[float], states: Sequence[SlipState], width: int = 1200) -> NDArray[np.uint8]:
    """A picture of slip score (1 is slip) and residual (px) over time, with the state as a coloured band."""
    height, left, low = 260, 50, 220
    picture = np.full((height, width, 3), 255, np.uint8)
    if not times_s:
        return picture
    span = max(times_s[-1] - times_s[0], 1e-9)
    u = [left + round((t - times_s[0]) / span * (width - left - 10)) for t in times_s]
    top = max(2.0, *(state.score for state in states))
    for k, state in enumerate(states):
        end = u[k + 1] if k + 1 < len(u) else u[k] + 2
        cv2.rectangle(picture, (u[k], low + 8), (end, low + 20), _COLOURS[state.state], -1)
    for share in (0.0, 1.0, top):
        v = round(low - share / top * 190)
        cv2.line(picture, (left, v), (width - 10, v), (0, 0, 200) if share == 1.0 else (210, 210, 210), 1)
        cv2.putText(picture, f"{share:.1f}", (6, v + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (90, 90, 90), 1, cv2.LINE_AA)
    residuals = [residual_px(state) for state in states]
    most = max(1.0, *residuals)
    _curve(picture, u, [low - 190 * value / most for value in residuals], _RESIDUAL)
    _curve(picture, u, [low - 190 * state.score / top for state in states], _SCORE)
    span_text = f"over {times_s[0]:.1f} .. {times_s[-1]:.1f} s"
    _label(picture, f"slip score {span_text}", left, height - 6, _SCORE)
    _label(picture, f"residual, full height {most:.1f} px", left + 300, height - 6, _RESIDUAL)
    return picture


def residual_px(state: SlipState) -> float:
    """The eighth largest deviation of a marker from the object's motion (as the rule of 2019 counts), 0 without one."""
    off = np.sort(np.linalg.norm(state.residual_px, axis=-1), axis=None)
    return float(off[-min(8, off.size)]) if off.size else 0.0


def _curve(picture: NDArray[np.uint8], u: Sequence[int], v: Sequence[float], colour: tuple[int, int, int]) -> None:
    points = np.array([(a, round(b)) for a, b in zip(u, v, strict=True)], np.int32).reshape(-1, 1, 2)
    cv2.polylines(picture, [points], isClosed=False, color=colour, thickness=1, lineType=cv2.LINE_AA)


def _label(picture: NDArray[np.uint8], text: str, left: int, low: int, colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, (left, low), cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
