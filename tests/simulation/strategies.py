"""Synthetic trials for tests that need no physics."""

from typing import Any

import numpy as np

from simulation.data.dataset import Manifest, Trial
from simulation.optics.appearance import Appearance


def made_up_trial(number: int = 0, **changes: Any) -> Trial:
    """A trial with smooth random gel states; ``changes`` replace fields."""
    rng = np.random.Generator(np.random.PCG64(number))
    gel = np.cumsum(rng.normal(0, 0.01, (30, 2, 1, 1, 3)) * np.ones((1, 1, 20, 21, 1)), axis=0)
    gel[..., 2] = np.abs(gel[..., 2])
    fields: dict[str, Any] = {
        "x_mm": float(rng.uniform(-15, 15)),
        "theta_deg": float(rng.uniform(-15, 15)),
        "object_name": "rectangle",
        "gap_width_mm": 56.0,
        "grasp_height_mm": 30.0,
        "group": number // 5,
        "poke": number % 5,
        "seed": number,
        "scene_sha256": "0" * 64,
        "onset_frame": 15,
        "true_slip_frame": 20,
        "stop_frame": 21,
        "outcome": "blocked",
        "split": ("train", "train", "validation", "test")[number % 4],
        "appearances": (Appearance(), Appearance(finger="right", seed=number // 5)),
        "gel": gel.astype(np.float16),
        "depth_mm": np.linspace(0, 5, 30, dtype=np.float32),
        "wrench": rng.normal(0, 1, (30, 6)).astype(np.float32),
        "in_hand": rng.normal(0, 0.01, (30, 6)).astype(np.float32),
    }
    return Trial(**(fields | changes))


def made_up_manifest(**changes: Any) -> Manifest:
    """The manifest of an empty collection of two shards of 12."""
    fields: dict[str, Any] = {
        "made_by": "test",
        "seed": 0,
        "trials_per_object": 24,
        "trials_per_shard": 12,
        "held_out_share": 0.1,
        "scenes": {"rectangle": "0" * 64},
    }
    return Manifest(**(fields | changes))
