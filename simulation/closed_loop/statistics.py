"""Statistics of closed-loop results; nothing here runs an insertion or draws."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simulation.closed_loop.baselines import CONTENDERS, SIGNS

Row = dict[str, Any]

OBJECTS = ("rectangle", "circle", "ellipse", "hexagon", "white_box", "vitamin", "can", "mustard")
TRAINING_OBJECTS = OBJECTS[:4]
FAILED_COUNTS_AS = 16
STILL_MM = 1.0  # blocks that moved by less count as unmoved
# Table I of the paper, measured on the real robot: success %, mean trials, maximum
PAPER: dict[str, tuple[float, float, str]] = {
    "rectangle": (100.0, 4.7, "11"),
    "circle": (100.0, 2.97, "5"),
    "ellipse": (100.0, 2.77, "8"),
    "hexagon": (100.0, 2.4, "6"),
    "white_box": (93.3, 6.53, ">15"),
    "vitamin": (96.7, 2.97, ">15"),
    "can": (93.3, 7.4, ">15"),
    "mustard": (100.0, 3.6, "9"),
}
# What this project set out to reach with the belief controller: success, mean trials
TARGETS: dict[str, tuple[float, float]] = {
    "rectangle": (0.99, 3.3),
    "circle": (0.99, 2.36),
    "ellipse": (0.99, 2.43),
    "hexagon": (0.99, 2.35),
    "white_box": (0.97, 3.8),
    "vitamin": (0.97, 2.3),
    "can": (0.97, 3.8),
    "mustard": (0.97, 2.8),
}


def wilson(successes: int, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson score interval of a share (Wilson 1927), both ends in 0..1."""
    if count == 0:
        return 0.0, 1.0
    p = successes / count
    centre = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count)) / (1 + z * z / count)
    return max(0.0, centre - half), min(1.0, centre + half)


def start_errors(count: int, seed: int, reach: tuple[float, float] = (15.0, 15.0)) -> list[tuple[float, float]]:
    """The paper's protocol: the four extremes first, then uniform random errors, mm and deg; ``reach`` bounds them."""
    rng = np.random.default_rng(seed)
    x, t = reach
    extremes = [(x, t), (x, -t), (-x, t), (-x, -t)]
    randoms = [(float(a), float(b)) for a, b in rng.uniform(-1.0, 1.0, (max(0, count - 4), 2)) * reach]
    return (extremes + randoms)[:count]


def trials_of(row: Row) -> int:
    """Attempts of an insertion, a failure counted as the paper does."""
    return int(row["attempts"]) if row["inserted"] else FAILED_COUNTS_AS


def summarise(rows: list[Row]) -> list[Row]:
    """One summary a (condition, contender, scene, eyes), contenders and scenes in their own order."""
    groups: dict[tuple[str, str, str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.get("condition", ""), row["who"], row["scene"], row.get("eyes", "pictures")].append(row)
    scenes = {name: index for index, name in enumerate(OBJECTS)}
    names = {name: index for index, name in enumerate(CONTENDERS)}

    def place(key: tuple[str, str, str, str]) -> tuple[str, int, int, str]:
        return key[0], names.get(key[1], 99), scenes.get(key[2], 99), key[3]

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
        "who": key[1],
        "scene": key[2],
        "eyes": key[3],
        "insertions": len(rows),
        "inserted": inserted,
        "success": inserted / len(rows),
        "success_interval": wilson(inserted, len(rows)),
        "mean_trials": float(trials.mean()),
        "mean_trials_standard_error": error,
        "max_trials": int(trials.max()),
        "blocks_under_1_mm": still / len(rows),
        "blocks_under_1_mm_interval": wilson(still, len(rows)),
        "worst_block_mm": max(course["block_mm"] for course in courses),
        "worst_block_tilt_deg": max(course["block_tilt_deg"] for course in courses),
        "grasp_kept": kept / len(rows),
        "grasp_kept_interval": wilson(kept, len(rows)),
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
            said = trial["decision"].get("class_probabilities")
            if said:
                counts[names.index(class_of(*trial["error_before"])), names.index(max(said, key=said.get))] += 1
    return counts


def estimates(rows: list[Row]) -> Row | None:
    """How good the networks' first estimates were: RMSE in mm and deg, right x side, spread against its sigma."""
    found = []
    for row in rows:
        decision = row["trials"][0]["decision"] if row["trials"] else {}
        if decision.get("type") == "correction":
            said = decision["estimate"]
            sigma = said["sigma_x_mm"] or math.nan, said["sigma_theta_deg"] or math.nan
            found.append((*row["trials"][0]["error_before"], said["dx_mm"], said["dtheta_deg"], *sigma))
    if not found:
        return None
    a = np.array(found)
    off = a[:, 2:4] - a[:, :2]
    clear = np.abs(a[:, 0]) > 2.5
    return {
        "decisions": len(a),
        "rmse_x_mm": float(np.sqrt(np.square(off[:, 0]).mean())),
        "rmse_theta_deg": float(np.sqrt(np.square(off[:, 1]).mean())),
        "wrong_side_x": float((a[clear, 0] * a[clear, 2] < 0).mean()) if clear.any() else 0.0,
        "x_errors_in_sigmas": float(np.sqrt(np.square(off[:, 0] / a[:, 4]).mean())),
    }
