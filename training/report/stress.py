"""A trained network where it was not trained: noisier cameras, new objects, the dearer tier of the physics."""

import json
from pathlib import Path

import numpy as np
import torch

from service.contract import ContractError
from training.config import DataConfig, RunConfig
from training.data.dataset import Source, Trials, open_source
from training.data.labels import CLASSES
from training.data.reading import load_drawn
from training.fit.checkpoint import Checkpoint
from training.fit.train import Trainer
from training.metrics.figures import by_object

NOISE_SCALES = (0.25, 0.5, 1.0, 2.0, 4.0)
STRESS_FILE = "stress.json"
Rows = dict[str, dict[str, float]]


def stress(run: Path, trials: int = 300, new: Path | None = None, layer: Path | None = None) -> Rows:
    """Score a finished run under stress, with the calibration of its validation trials; keeps ``stress.json`` in it.

    Args:
        run: folder of a finished run.
        trials: validation collisions to draw again at each noise.
        new: dataset of objects that training never saw.
        layer: dataset of the training objects simulated in the ``layer`` tier.

    Raises ContractError if ``run`` is not a finished run, a dataset cannot be read or ``trials`` is below 1.
    """
    if trials < 1:
        raise ContractError(f"--trials {trials}: expected at least 1")
    try:
        config = RunConfig.model_validate_json((run / "config.json").read_text())
    except (OSError, ValueError) as error:
        raise ContractError(f"{run} is not the folder of a training run: no valid config.json") from error
    checkpoint = Checkpoint.load(run / "checkpoint.pt")
    rows: Rows = {}

    def score(name: str, data: DataConfig, source: Source) -> None:
        drawn = load_drawn(data, config.network.kind, source)
        rows.update({f"{name}/{row}": values for row, values in _scored(config, checkpoint, drawn).items()})

    few = config.data.model_copy(update={"rendered_training": 0, "rendered_validation": trials, "rendered_test": 0})
    for scale in NOISE_SCALES:
        score(f"noise x {scale:g}", few, open_source(config.data.path, noise_scale=scale))
    every = {"rendered_training": 10_000, "rendered_validation": 10_000, "rendered_test": 10_000}
    for name, folder in (("new objects", new), ("layer tier", layer)):
        if folder is not None:
            score(name, config.data.model_copy(update={"path": str(folder), **every}), open_source(str(folder)))
    (run / STRESS_FILE).write_text(json.dumps(rows, indent=1))
    return rows


def _scored(config: RunConfig, checkpoint: Checkpoint, trials: Trials) -> Rows:
    """Figures of all drawn trials; the stated calibration is the checkpoint's."""
    trainer = Trainer(config, trials, checkpoint.build(), torch.ones(len(CLASSES)), torch.zeros(2, 3))
    predictions = trainer.predict(np.flatnonzero(trials.picture >= 0), pictures=True)
    return by_object(predictions.rescaled(checkpoint.scales))
