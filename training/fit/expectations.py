"""A belief's expectations of attempts: errors as in the training data, creep as in played insertions.

A blocked object is left turned in the hand, its bottom outwards. The amount is the difference between its error before
an attempt, the move made, and its error before the next attempt.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from reporting.files import read_rows
from service.contract import ContractError
from service.contract.frames import first_error
from service.contract.model_card import Expectations

Floats = NDArray[np.float64]
MISPLACED = (2.0, 2.0)
"""Usual errors of a cell's frames, mm and deg: a start may lie this far beyond those collected."""
FEWEST = 40
LEVER_FROM_MM = 30.0
LEAST_SPREAD_MM, LEAST_SPREAD_DEG = 0.2, 0.2
_STILL_MM = 0.3  # below this, the side of an error has no meaning


def of_errors(error: Floats, given: Expectations) -> Expectations:
    """``given`` with prior and spread of training errors [N, 2] (mm, deg)."""
    edge = np.quantile(np.abs(error), 0.999, axis=0) + MISPLACED
    spread = error.std(0)
    return given.model_copy(update={"edge": tuple(map(float, edge)), "spread": tuple(map(float, spread))})


def of_insertions(paths: Iterable[Path], given: Expectations) -> Expectations:
    """``given`` with the creep of played attempts; ContractError where there are too few.

    Each path is a log of `python -m simulation evaluate`, of one controller with one state of networks and code. An
    oracle's moves are no answer to what these networks read, so its log is refused. Medians and median deviations are
    used: a few attempts that slipped far are no creep.
    """
    steps = np.array([step for path in paths for step in _played(path)], np.float64)
    if len(steps) < FEWEST:
        raise ContractError(f"{len(steps)} pairs of attempts in these logs, expected at least {FEWEST}")
    before_mm, gone_mm, turned_deg, lever_mm = steps.T
    outwards = np.sign(before_mm) * gone_mm
    near = np.abs(before_mm) < given.near_mm
    far_mm, far_spread = _middle(outwards[~near], LEAST_SPREAD_MM)
    near_mm, per_mm = _line(lever_mm[near], outwards[near])
    _, near_spread = _middle(outwards[near] - near_mm - per_mm * lever_mm[near], LEAST_SPREAD_MM)
    _, theta_spread = _middle(turned_deg, LEAST_SPREAD_DEG)
    measured = {
        "creep_mm": far_mm,
        "creep_near_mm": near_mm,
        "creep_near_mm_per_mm": per_mm,
        "creep_spread_mm": far_spread,
        "creep_near_more_mm": max(0.0, near_spread - far_spread),
        "creep_theta_deg": theta_spread,
    }
    try:
        return Expectations.model_validate(given.model_dump() | measured)
    except ValidationError as error:
        raise ContractError(
            f"the creep in these logs is none that a belief can expect: {first_error(error)}"
        ) from error


def _played(path: Path) -> list[tuple[float, float, float, float]]:
    rows = _rows(path)
    try:
        return [step for row in rows for step in _steps(row)]
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise ContractError(f"{path}: expected the .insertions.jsonl of an evaluation, not {error!r}") from error


def _rows(path: Path) -> list[dict[str, Any]]:
    """The insertions of a log; a line that a kill truncated is no insertion."""
    try:
        rows = [row for row in read_rows(path) if isinstance(row, dict) and "trials" in row]
    except ValueError:  # not even text
        rows = []
    if not rows:
        raise ContractError(f"{path}: expected the .insertions.jsonl of an evaluation, no insertion in it")
    played = {(str(row.get("controller")), str(row.get("made_by"))) for row in rows}
    if len(played) > 1 or played & {("oracle", made_by) for _, made_by in played}:
        who = ", ".join(sorted({f"{controller} ({made_by[:8]})" for controller, made_by in played}))
        raise ContractError(
            f"{path} holds insertions of {who}: expected one controller, no oracle, with one state of code"
        )
    return rows


def _steps(row: Mapping[str, Any]) -> Iterator[tuple[float, float, float, float]]:
    """Error in x before an attempt, its creep in x (mm) and yaw (deg), and its grasp height above 30 mm.

    Attempts count from 1 again in a new grasp, in which nothing of the earlier creep is left.
    """
    height_mm = float(row["grasp_height_mm"])
    for one, following in zip(row["trials"], row["trials"][1:], strict=False):
        if following["decision"]["attempt"] != one["decision"]["attempt"] + 1:
            continue
        (x_mm, yaw_deg), (next_x, next_yaw), move = one["error_before"], following["error_before"], one["decision"]
        if "dx_mm" in move and abs(x_mm) > _STILL_MM:
            crept = next_x - x_mm - move["dx_mm"], next_yaw - yaw_deg - move["dtheta_deg"]
            yield x_mm, *crept, max(0.0, height_mm - LEVER_FROM_MM)


def _middle(values: Floats, least: float) -> tuple[float, float]:
    """Median, and a standard deviation from the median deviation."""
    if not len(values):
        return 0.0, least
    middle = float(np.median(values))
    return middle, max(least, 1.4826 * float(np.median(np.abs(values - middle))))


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Offset and slope of a line through points, outliers down-weighted (Huber's weights, ten rounds)."""
    offset, slope = _middle(y, LEAST_SPREAD_MM)[0], 0.0
    if len(x) < FEWEST // 2 or float(np.ptp(x)) == 0.0:
        return offset, slope
    for _ in range(10):
        off = y - offset - slope * x
        weight = np.minimum(1.0, 1.5 * _middle(off, LEAST_SPREAD_MM)[1] / np.maximum(np.abs(off), 1e-9))
        design = np.column_stack([np.ones_like(x), x]) * np.sqrt(weight)[:, None]
        offset, slope = (float(value) for value in np.linalg.lstsq(design, y * np.sqrt(weight), rcond=None)[0])
    return offset, slope
