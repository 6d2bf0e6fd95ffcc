"""`python -m simulation view`: trials of a dataset as pictures."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from simulation.data.dataset import Dataset, Trial, slice_of
from simulation.optics import attempt_picture

DECISION_FRAMES = 8


@dataclass(frozen=True, slots=True)
class Options:
    """Draw trials of a dataset: imprints with dot motion, the 8 difference frames, the true error."""

    source: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset, or one of its shards."""
    out: Path = Path("runs/view")
    """Folder for the PNG files."""
    first: int = 0
    """Number of the first trial to draw."""
    count: int = 6
    """How many trials to draw."""


def chosen_trials(options: Options) -> tuple[Dataset, list[int]]:
    """The dataset and the numbers of the trials to draw; DatasetError if there are none."""
    is_shard = options.source.suffix == ".parquet"
    dataset = Dataset(options.source.parent if is_shard else options.source, verify=False)
    numbers = dataset.trials_of_shard(options.source.name) if is_shard else list(range(len(dataset)))
    return dataset, slice_of(numbers, options.first, options.count, options.source)


def true_motion(trial: Trial, start: int, stop: int) -> attempt_picture.Motion:
    """Where the dots rest and their true motion from frame ``start`` to frame ``stop``, rectified px."""
    gel = trial.gel[..., :2].astype(np.float32)
    motion = (gel[stop] - gel[start]) / np.float32(trial.sensor.mm_per_px)
    return np.broadcast_to(trial.sensor.marker_rest_px(), motion.shape), motion


def describe(trial: Trial, number: int) -> attempt_picture.Decision:
    """What the picture of a logged trial says."""
    force_n = float(np.linalg.norm(trial.wrench[trial.onset_frame + DECISION_FRAMES - 1, :3]))
    return {
        "title": f"trial {number}: {trial.object_name}, {trial.split}, {trial.outcome}",
        "truth": (trial.x_mm, trial.theta_deg),
        "notes": (
            f"gap {trial.gap_width_mm:.1f} mm, held {trial.grasp_height_mm:.0f} mm above its bottom",
            f"re-fixture {trial.group}, poke {trial.poke}",
            f"onset {trial.onset_frame}, slip {trial.true_slip_frame}, stop {trial.stop_frame} of 30 frames",
            f"force at the last frame {force_n:.1f} N",
        ),
    }


def main(arguments: Sequence[str]) -> int:
    """Run the command line."""
    options = tyro.cli(Options, args=arguments, prog="tactile-insertion view")
    dataset, numbers = chosen_trials(options)
    for number in numbers:
        trial = dataset.trial(number)
        motion = true_motion(trial, trial.onset_frame, trial.onset_frame + DECISION_FRAMES - 1)
        path = options.out / f"trial-{number:06d}.png"
        print(attempt_picture.save(path, dataset.frames(number), describe(trial, number), motion))
    return 0
