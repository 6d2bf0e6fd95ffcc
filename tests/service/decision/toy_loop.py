"""A toy closed loop for controllers: geometry decides insertion, evidence is drawn from a known, calibrated error."""

import numpy as np

from service.contract.wire import Limits
from service.decision.controllers import make_controller
from service.decision.evidence import Evidence
from tests.service.tiny_models import CLASSES, SIGNS

SHARP = (1.5, 2.5)
LIMITS = Limits(max_dx_mm=15.0, max_dtheta_deg=15.0, max_frame_age_ms=500.0)


def inserts(x_mm: float, theta_deg: float, width_mm: float = 51.0, length_mm: float = 80.0) -> bool:
    """|x| + half-width of the yawed rectangle <= G/2."""
    theta = np.deg2rad(abs(theta_deg))
    return abs(x_mm) + width_mm / 2 * np.cos(theta) + length_mm / 2 * np.sin(theta) <= 56.0 / 2


def evidence(x_mm: float, theta_deg: float, rng: np.random.Generator, sigma: tuple[float, float]) -> Evidence:
    """Answers of calibrated networks: a noisy reading, and class probabilities from its posterior."""
    centre = (x_mm + rng.normal(0, sigma[0]), theta_deg + rng.normal(0, sigma[1]))
    draws = rng.normal(centre, sigma, (4000, 2))
    sign_x = np.sign(draws[:, 0]) * (np.abs(draws[:, 0]) > 2.5)
    sign_theta = np.sign(draws[:, 1]) * (np.abs(draws[:, 1]) > 5)
    signs = SIGNS | {"near": (0, 0)}
    share = np.array([np.mean((sign_x == signs[c.name][0]) & (sign_theta == signs[c.name][1])) for c in CLASSES])
    share = 0.98 * share + 0.02 / len(CLASSES)
    return Evidence(CLASSES, share, centre, sigma)


def trials(
    name: str,
    x_mm: float,
    theta_deg: float,
    rng: np.random.Generator,
    sigma: tuple[float, float],
    *,
    length_mm: float = 80.0,
    stated_mm: float | None = None,
) -> int:
    """Attempts until insertion; 16 for a failure after 15. ``told_mm``: the length reported by the gripper."""
    controller = make_controller(name, LIMITS, length_mm=stated_mm)  # type: ignore[arg-type]
    for attempt in range(1, 16):
        if inserts(x_mm, theta_deg, length_mm=length_mm):
            return attempt
        command = controller.decide(evidence(x_mm, theta_deg, rng, sigma), attempt)
        x_mm, theta_deg = x_mm + command.dx_mm, theta_deg + command.dtheta_deg
        x_mm, theta_deg = x_mm + rng.normal(0, 0.1), theta_deg + rng.normal(0, 0.2)
    return 16


def mean_trials(name: str, n: int, sigma: tuple[float, float], seed: int = 0) -> float:
    """Over uniform starts in +-15 mm, +-15 deg."""
    rng = np.random.default_rng(seed)
    starts = rng.uniform(-15, 15, (n, 2))
    return float(np.mean([trials(name, x, theta, rng, sigma) for x, theta in starts]))
