"""Ends of ten probes, recorded at commit 1ac29a3; processors that round otherwise agree to one part in a million."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulation.data.probe import run_probe
from simulation.scene.worlds import load_scene

ROWS = json.loads(Path(__file__).with_name("probes.json").read_text())


def probe(row: dict[str, Any]) -> dict[str, Any]:
    scene = load_scene(row["scene"]).varied(row["changes"])
    made = run_probe(scene, row["x_mm"], row["theta_deg"], seed=row["seed"])
    return {
        "outcome": made.outcome,
        "onset_frame": made.onset_frame,
        "true_slip_frame": made.true_slip_frame,
        "stop_frame": made.stop_frame,
        "block_motion": np.ravel(made.block_motion).tolist(),
        "wrench": made.wrench[-1].tolist(),
        "in_hand": made.in_hand[-1].tolist(),
    }


def test_probes_are_as_recorded() -> None:
    for row in ROWS:
        made, recorded = probe(row), row["result"]
        assert made.keys() == recorded.keys()
        for name, value in recorded.items():
            expected = pytest.approx(value, rel=1e-6, abs=1e-6) if isinstance(value, list) else value
            assert made[name] == expected, f"{row['scene']} seed {row['seed']}: {name}"
