"""Statistics of closed-loop results; nothing here runs an insertion or draws."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.statistics import wilson
from simulation.closed_loop.baselines import CONTROLLERS, SIGNS
from simulation.scene.worlds import known_object

Row = dict[str, Any]

FAILED_COUNTS_AS = 16
STILL_MM = 1.0  # blocks that moved by less count as unmoved


def start_errors(count: int, seed: int, reach: tuple[float, float] = (15.0, 15.0)) -> list[tuple[float, float]]:
    """The paper's protocol: the four extremes first, then uniform random errors, mm and deg; ``reach`` bounds them."""
    rng = np.random.default_rng(seed)
    x, t = reach
    extremes = [(x, t), (x, -t), (-x, t), (-x, -t)]
    randoms = [(float(a), float(b)) for a, b in rng.uniform(-1.0, 1.0, (max(0, count - 4), 2)) * reach]
    return (extremes + randoms)[:count]


def title_of(scene: str) -> str:
    """Name of an object that a row calls by its name or by the path of its file."""
    return Path(scene).stem


def trained_on(scene: str) -> bool:
    """Whether the released networks were trained on an object."""
    known = known_object(scene)
    return known is not None and known.training


def in_order(scenes: Iterable[str]) -> list[str]:
    """Each object once, as tables list them: in the order that their files state, then by name."""

    def place(scene: str) -> tuple[float, str]:
        known = known_object(scene)
        return math.inf if known is None or known.order is None else known.order, title_of(scene)

    return sorted(set(scenes), key=place)


def trials_of(row: Row) -> int:
    """Attempts of an insertion, a failure counted as the paper does."""
    return int(row["attempts"]) if row["inserted"] else FAILED_COUNTS_AS


def summarise(rows: list[Row]) -> list[Row]:
    """One summary a (condition, controller, object, perception), controllers and objects in their own order."""
    groups: dict[tuple[str, str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["condition"], row["controller"], row["scene"], row["perception"]].append(row)
    scenes, controllers = in_order(row["scene"] for row in rows), list(CONTROLLERS)

    def place(key: tuple[str, str, str, str]) -> tuple[str, int, int, str]:
        return key[0], controllers.index(key[1]), scenes.index(key[2]), key[3]

    return [_summary(key, groups[key]) for key in sorted(groups, key=place)]


def _summary(key: tuple[str, str, str, str], rows: list[Row]) -> Row:
    trials = np.array([trials_of(row) for row in rows], float)
    courses = [row["course"] for row in rows]
    inserted = sum(row["inserted"] for row in rows)
    still = sum(course["block_mm"] < STILL_MM for course in courses)
    kept = sum(row["grasp_kept"] for row in rows)
    error = float(trials.std(ddof=1) / math.sqrt(len(trials))) if len(trials) > 1 else None
    return {
        "condition": key[0],
        "controller": key[1],
        "scene": key[2],
        "training": trained_on(key[2]),
        "perception": key[3],
        "insertions": len(rows),
        "inserted": inserted,
        "success": inserted / len(rows),
        "success_interval": wilson(inserted, len(rows))[1:],
        "mean_trials": float(trials.mean()),
        "mean_trials_standard_error": error,
        "max_trials": int(trials.max()),
        "blocks_under_1_mm": still / len(rows),
        "blocks_under_1_mm_interval": wilson(still, len(rows))[1:],
        "worst_block_mm": max(course["block_mm"] for course in courses),
        "worst_block_tilt_deg": max(course["block_tilt_deg"] for course in courses),
        "grasp_kept": kept / len(rows),
        "grasp_kept_interval": wilson(kept, len(rows))[1:],
        "worst_slip_in_hand_mm": max(course["slipped_mm"] for course in courses),
        "worst_in_hand_mm": max(course["in_hand_mm"] for course in courses),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "void": sum(row["void"] for row in rows),
        "refused": sum(t["decision"]["type"] == "no_decision" for row in rows for t in row["trials"]),
    }


def class_of(x_mm: float, theta_deg: float, t_x_mm: float = 2.5, t_theta_deg: float = 5.0) -> str:
    """The error class of a true error."""
    signs = (_sign(x_mm, t_x_mm), _sign(theta_deg, t_theta_deg))
    return next(name for name, pair in SIGNS.items() if pair == signs)


def _sign(value: float, threshold: float) -> int:
    return 0 if abs(value) <= threshold else int(math.copysign(1, value))


def confusion(rows: list[Row]) -> NDArray[np.int64]:
    """[9, 9] counts over all decided attempts: true class (row) against the most probable one (column)."""
    names = list(SIGNS)
    counts = np.zeros((9, 9), np.int64)
    for row in rows:
        for trial in row["trials"]:
            classes = trial["decision"].get("class_probabilities")
            if classes:
                counts[names.index(class_of(*trial["error_before"])), names.index(max(classes, key=classes.get))] += 1
    return counts


def first_decisions(rows: Iterable[Row]) -> list[Row]:
    """The first trial of each insertion that began with a correction."""
    firsts = (row["trials"][0] for row in rows if row["trials"])
    return [trial for trial in firsts if trial["decision"]["type"] == "correction"]


def refused(row: Row) -> bool:
    """Whether the service or the client ended the insertion by itself instead of using up its trials."""
    return not (row["inserted"] or row["claimed"] or row["void"]) and row["attempts"] < FAILED_COUNTS_AS - 1


def ends(rows: Sequence[Row]) -> Row:
    """How insertions ended, counted; a failure counts as 16 trials."""
    return {
        "insertions": len(rows),
        "inserted": sum(row["inserted"] for row in rows),
        "claimed_wrongly": sum(row["claimed"] and not row["inserted"] for row in rows),
        "refused": sum(refused(row) for row in rows),
        "void": sum(row["void"] for row in rows),
        "mean_trials": sum(trials_of(row) for row in rows) / len(rows),
    }


def estimates(rows: list[Row]) -> Row | None:
    """How good the networks' first estimates were: RMSE in mm and deg, right x side, spread against its sigma."""
    firsts = []
    for trial in first_decisions(rows):
        estimate = trial["decision"]["estimate"]
        sigma = estimate["sigma_x_mm"] or math.nan, estimate["sigma_theta_deg"] or math.nan
        firsts.append((*trial["error_before"], estimate["dx_mm"], estimate["dtheta_deg"], *sigma))
    if not firsts:
        return None
    a = np.array(firsts)
    off = a[:, 2:4] - a[:, :2]
    clear = np.abs(a[:, 0]) > 2.5
    return {
        "decisions": len(a),
        "rmse_x_mm": float(np.sqrt(np.square(off[:, 0]).mean())),
        "rmse_theta_deg": float(np.sqrt(np.square(off[:, 1]).mean())),
        "wrong_side_x": float((a[clear, 0] * a[clear, 2] < 0).mean()) if clear.any() else 0.0,
        "x_errors_in_sigmas": float(np.sqrt(np.square(off[:, 0] / a[:, 4]).mean())),
    }
