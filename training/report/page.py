"""``python -m training report RUN``: the training report, its tables and its two pictures, from a finished run."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from service.contract import ContractError
from training.config import RunConfig
from training.data.dataset import Source, Trials, load_trials
from training.data.labels import CLASSES, class_of
from training.fit.checkpoint import Checkpoint
from training.fit.train import MOST_SCORED, Trainer
from training.metrics.figures import (
    Predictions,
    calibrate,
    calibration_curve,
    confusion,
    cross_calibrated,
    figures,
    probabilities,
    rescaled,
    wilson,
)
from training.networks import reads
from training.report.oracle import oracle_figures
from training.report.stress import STRESS_FILE

COLUMNS = {
    "trials": "trials",
    "accuracy": "direction",
    "accuracy_without_near": "without near",
    "chance": "chance",
    "ece": "ECE",
    "wrong_side_x": "wrong side x",
    "mae_x_mm": "MAE x mm",
    "mae_theta_deg": "MAE yaw deg",
    "rmse_x_mm": "RMSE x mm",
    "rmse_theta_deg": "RMSE yaw deg",
    "coverage90_x": "90 % covers x",
    "coverage90_theta": "covers yaw",
}
TRUE_FIELDS = {
    "pictures": """\
"true fields": the same trunk on the gel's true motion and pressure instead of pictures; what is lost between these rows
and those above is lost in reading the pictures (the trunk was last trained on what the front reads, so it bounds the
loss from one side only).""",
    "markers": """\
"true fields": the same network on the markers' true motion instead of what is tracked in pictures; what is lost between
these rows and those above is lost in tracking.""",
}
SHARES = ("accuracy", "accuracy_without_near", "chance", "ece", "wrong_side_x", "coverage90_x", "coverage90_theta")


def write_report(run: Path, out: Path, source: Source | None = None, recipe: Path | None = None) -> Path:
    """Write ``<out>/training.md`` and ``training.png``; raise ContractError if ``run`` is not a finished run.

    ``recipe`` is the folder of a finished run of the paper's recipe, whose figures then stand beside ours.
    """
    try:
        config = RunConfig.model_validate_json((run / "config.json").read_text())
    except (OSError, ValueError) as error:
        raise ContractError(f"{run} is not the folder of a training run: no valid config.json") from error
    checkpoint = Checkpoint.load(run / "checkpoint.pt")
    beside = recipe_section(recipe, checkpoint.training_data_sha256)  # a wrong folder is refused before all the scoring
    torch.set_num_threads(config.threads)
    trials = load_trials(config.data, source, reads(config.network.kind))
    trainer = Trainer(config, trials, checkpoint.build(), torch.ones(len(CLASSES)), torch.zeros(2, 3))
    held = trials.of("validation", rendered=True)[:MOST_SCORED]
    if not len(held):
        raise ContractError(f"{run} has no rendered validation trials; see data.rendered_validation")
    said = cross_calibrated(trainer.predict(held, pictures=True), trials.groups[held])
    out.mkdir(parents=True, exist_ok=True)
    _draw(said, out / "training.png")
    tables = {name: row for name, row in checkpoint.figures.items() if not name.startswith("joint/")}
    joint = {name[6:]: row for name, row in checkpoint.figures.items() if name.startswith("joint/")}
    page = out / "training.md"
    told = oracle_figures(trials, run / "oracle")
    limits = _limits(trainer) | {name.replace("/", "/oracle, "): row for name, row in told.items()}
    page.write_text(_page(checkpoint, trials, tables, joint, limits) + stress_section(run) + beside)
    return page


def _limits(trainer: Trainer) -> dict[str, dict[str, float]]:
    """The same decision from the true marker fields instead of pictures, calibrated as the rows above are."""
    trials, rows = trainer.trials, {}
    scales = calibrate(trainer.predict(trials.of("validation", rendered=True)[:MOST_SCORED], pictures=False))
    for split in ("validation", "test"):
        chosen = trials.of(split, rendered=True)[:MOST_SCORED]
        if len(chosen):
            said = trainer.predict(chosen, pictures=False)
            fair = cross_calibrated(said, trials.groups[chosen]) if split == "validation" else rescaled(said, scales)
            rows[f"{split}/true fields"] = figures(fair)
    return rows


def _page(
    checkpoint: Checkpoint,
    trials: Trials,
    tables: dict[str, dict[str, float]],
    joint: dict[str, dict[str, float]],
    limits: dict[str, dict[str, float]],
) -> str:
    collected, same = len(trials), checkpoint.training_data_sha256 == trials.sha256
    other = "" if same else f" The limits and pictures below are of other data now there (`{trials.sha256[:12]}`)."
    size = sum(value.numel() for name, value in checkpoint.weights.items() if name != "field_scale")
    return f"""# Training report

Written by `python -m training report`. Network `{checkpoint.name}` ({size / 1e6:.2f} M weights), {collected} simulated
collisions (data `{checkpoint.training_data_sha256[:12]}`), commit `{checkpoint.git_commit[:12]}`. Re-fixture groups
never cross splits. `validation` chose the epoch at which each stage ended and is calibrated on its own other half;
`test` comes from ranges of size, friction, stiffness and noise that training never saw, with the calibration of
`validation`. All figures are of the simulator.{other}

## The pair

{_table(tables)}

## The joint density

{_table({name: row for name, row in joint.items() if name.endswith("/all")})}

## The information limit

{TRUE_FIELDS[reads(checkpoint.network.kind)]}
The oracle is a network of the same size that sees the object's true motion in the hand, which is all that a gel can
tell; what it gets wrong, no tactile network is to be blamed for.

{_table(limits)}

![Confusion matrix and calibration curve on validation](training.png)
"""


def stress_section(run: Path) -> str:
    """Noise, new objects and the dearer physics, as a section; empty where `training stress` has not run."""
    path = run / STRESS_FILE
    if not path.exists():
        return ""
    return f"""
## Where it was not trained

Validation collisions drawn again with the noise of the cameras multiplied; objects that training never saw, in the
same ranges of size, grasp and friction; and the training objects in the `layer` tier, whose gel couples its nodes: the
honest stand-in here for another world than the one trained in. Calibration is that of the validation split.

{_table(json.loads(path.read_text()))}
"""


def recipe_section(recipe: Path | None, data_sha256: str) -> str:
    """The paper's own recipe in the same simulator, as a section of the report; empty without a run of it."""
    if recipe is None:
        return ""
    checkpoint = Checkpoint.load(recipe / "checkpoint.pt")
    if checkpoint.network.kind != "alexnet_lstm":
        kind = checkpoint.network.kind
        raise ContractError(f"--recipe {recipe} holds a {kind} network, expected a run of `python -m training recipe`")
    rows = {name: row for name, row in checkpoint.figures.items() if name.endswith("/all") or name.startswith("valid")}
    trials = checkpoint.figures["train/all"]["trials"]
    same = checkpoint.training_data_sha256 == data_sha256
    other = (
        "" if same else " Those are not the data above, or not all of them: its rows do not compare with those above."
    )
    imagenet = checkpoint.run.get("imagenet")
    frozen = (
        "of ImageNet" if imagenet else "here pretrained on simulated\nimprints because no ImageNet weights were at hand"
    )
    return f"""
## The paper's own recipe, same simulator

Two independent AlexNet-LSTM networks (`python -m training recipe`): frozen convolutions, {frozen},
classes 7 and 8 doubled, Adam. Trained on {trials:.0f} trials of data `{checkpoint.training_data_sha256[:12]}`,
what two cores allow in about an hour; the paper had 30,000 real ones and reports 80.5 % on training and 74.4 % on
validation trials. Its MagnitudeNN has no sigma: coverage is that of one constant spread.{other}

{_table(rows)}
"""


def _table(rows: dict[str, dict[str, float]]) -> str:
    lines = ["| split / object | " + " | ".join(COLUMNS.values()) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, row in rows.items():
        cells = [_cell(key, row) for key in COLUMNS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(key: str, row: dict[str, float]) -> str:
    if key == "trials":
        return f"{row[key]:.0f}"
    if key == "accuracy":
        low, high = wilson(row[key], int(row["trials"]))
        return f"{100 * row[key]:.1f} % ({100 * low:.0f} .. {100 * high:.0f})"
    return f"{100 * row[key]:.1f} %" if key in SHARES else f"{row[key]:.2f}"


def _draw(said: Predictions, path: Path) -> None:
    """Confusion matrix (shares of each true class) and calibration curve."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    labels = class_of(said.truth.astype(np.float32))
    p = probabilities(said.logits, 1.0)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 5), layout="constrained")
    _draw_confusion(left, confusion(p, labels))
    confidence, accuracy, count = calibration_curve(p, labels)
    right.plot([0, 1], [0, 1], color="grey", linewidth=1)
    right.scatter(confidence, accuracy, s=8 + 200 * count / count.max())
    right.set(xlabel="confidence", ylabel="accuracy", xlim=(0, 1), ylim=(0, 1), title="calibration, area = trials")
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_confusion(axes: Any, table: np.ndarray[Any, Any]) -> None:
    names = [entry.name for entry in CLASSES]
    shares = table / np.maximum(table.sum(1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1)
    for row, column in np.ndindex(table.shape):
        if table[row, column]:
            colour = "white" if shares[row, column] > 0.5 else "black"
            axes.text(column, row, str(table[row, column]), ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(names)), names)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="chosen class", ylabel="true class", title="validation trials")
