"""Synthetic trials for tests that need no physics."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simulation.data.dataset import DatasetWriter, Manifest, ShardEntry, Trial, encode_shard
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


def made_up_dataset(folder: Path, trials: Sequence[Trial], trials_per_shard: int = 12) -> Path:
    """A finished dataset of these trials; the folder."""
    sizes = {"trials_per_object": len(trials), "trials_per_shard": trials_per_shard}
    with DatasetWriter(folder, made_up_manifest(**sizes)) as writer:
        for shard, first in enumerate(range(0, len(trials), trials_per_shard)):
            name = f"rectangle-{shard:05d}.parquet"
            writer.commit(written(folder / name, trials[first : first + trials_per_shard]))
        assert writer.finish()
    return folder


def written(path: Path, trials: Sequence[Trial]) -> ShardEntry:
    """A shard on disk that no manifest lists yet."""
    entry, data = encode_shard(path.name, trials)
    path.write_bytes(data)
    return entry
