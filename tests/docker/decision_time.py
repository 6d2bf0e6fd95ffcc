"""How long the networks take after the last frame: p50 and p99 in ms over N decisions, and which they are, as JSON.

usage: python decision_time.py MODELS [N]      Run with the service importable, inside a container and outside.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np

from service.decision.models import load_models


def main(folder: str, decisions: int) -> None:
    """Time one step of every deciding network on random input, the work that is left when the eighth frame arrives."""
    models = load_models(Path(folder))
    shape = (2, *models.card.input_shape)
    rng = np.random.default_rng(0)
    levels = 2 if models.card.markers else 256
    frames = [rng.integers(0, levels, shape).astype(models.card.input_dtype) for _ in range(4)]
    states = [step.fresh_state() for step in models.steps]
    wall_ms, cpu_ms = [], []
    for index in range(decisions):
        started, began = time.perf_counter(), time.thread_time()
        for step, state in zip(models.steps, states, strict=True):
            step.step(frames[index % 4], frames[0], state, 56.0)
        cpu_ms.append((time.thread_time() - began) * 1e3)
        wall_ms.append((time.perf_counter() - started) * 1e3)
    p50, p99 = np.percentile(wall_ms, (50, 99))
    cpu_p99 = np.percentile(cpu_ms, 99)
    networks = [step.sha256 for step in models.steps]
    figures = {"p50_ms": float(p50), "p99_ms": float(p99), "cpu_p99_ms": float(cpu_p99), "networks": networks}
    print(json.dumps(figures))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 500)
