"""``python -m training report RUN``: the training report, its tables and its figure, from a finished run."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from reporting import figure
from reporting.page import page, publish
from reporting.statistics import wilson
from reporting.table import Table, table
from service.contract import ContractError
from training.config import RunConfig
from training.data.dataset import Source, Trials
from training.data.labels import CLASSES, class_of
from training.data.reading import load_drawn
from training.fit.checkpoint import Checkpoint
from training.fit.train import MOST_SCORED, Trainer
from training.metrics.figures import (
    Predictions,
    calibration_curve,
    confusion,
    cross_calibrated,
    figures,
    probabilities,
)
from training.networks import reads
from training.report.oracle import oracle_figures
from training.report.stress import STRESS_FILE

Rows = dict[str, dict[str, float]]
TRUE_FIELDS = {
    "pictures": """
        "true fields": the same trunk on the gel's true motion and pressure instead of pictures. What is lost between
        these rows and those above is lost in reading the pictures. The trunk was last trained on what the front reads,
        so it bounds the loss from one side only.
        """,
    "markers": """
        "true fields": the same network on the markers' true motion instead of what is tracked in pictures. What is
        lost between these rows and those above is lost in tracking.
        """,
}


def write_report(run: Path, out: Path, source: Source | None = None, recipe: Path | None = None) -> Path:
    """Write ``<out>/training.md`` and ``training.png``; raise ContractError if ``run`` is not a finished run.

    ``recipe`` is the folder of a finished run of the paper's recipe, whose figures then stand beside ours.
    """
    try:
        config = RunConfig.model_validate_json((run / "config.json").read_text())
    except (OSError, ValueError) as error:
        raise ContractError(f"{run} is not the folder of a training run: no valid config.json") from error
    checkpoint = Checkpoint.load(run / "checkpoint.pt")
    baseline = recipe_part(recipe, checkpoint.training_data_sha256)  # a wrong folder is refused before all the scoring
    torch.set_num_threads(config.threads)
    trials = load_drawn(config.data, config.network.kind, source)
    trainer = Trainer(config, trials, checkpoint.build(), torch.ones(len(CLASSES)), torch.zeros(2, 3))
    held = trials.of("validation", rendered=True)[:MOST_SCORED]
    if not len(held):
        raise ContractError(f"{run} has no rendered validation trials; see data.rendered_validation")
    _draw(cross_calibrated(trainer.predict(held, pictures=True), trials.groups[held]), out / "training.png")
    oracle = {name.replace("/", "/oracle, "): row for name, row in oracle_figures(trials, run / "oracle").items()}
    parts = (*_networks(checkpoint, trials, _limits(trainer) | oracle), *stress_part(run), *baseline)
    publish(out, "training", page(*parts))
    return out / "training.md"


def _limits(trainer: Trainer) -> Rows:
    """The same decision from the true marker fields instead of pictures, calibrated as the rows above are."""
    trials, rows = trainer.trials, {}
    scales = trainer.predict(trials.of("validation", rendered=True)[:MOST_SCORED], pictures=False).calibration()
    for split in ("validation", "test"):
        chosen = trials.of(split, rendered=True)[:MOST_SCORED]
        if len(chosen):
            raw = trainer.predict(chosen, pictures=False)
            fair = cross_calibrated(raw, trials.groups[chosen]) if split == "validation" else raw.rescaled(scales)
            rows[f"{split}/true fields"] = figures(fair)
    return rows


def _networks(checkpoint: Checkpoint, trials: Trials, limits: Rows) -> Iterator[str | Table]:
    rows, joint = checkpoint.figures, "joint/"
    data, size = checkpoint.training_data_sha256, sum(value.numel() for value in _weights(checkpoint))
    yield f"""
        # Training report

        Written by `python -m training report`. Network `{checkpoint.name}` ({size / 1e6:.2f} M weights),
        {len(trials)} simulated collisions (data `{data[:12]}`), commit `{checkpoint.git_commit[:12]}`. Re-fixture
        groups never cross splits. `validation` chose the epoch at which each stage ended, and each half of it is
        calibrated on the other. `test` comes from ranges of size, friction, stiffness and noise that training never
        saw, with the calibration of `validation`. Shares of right directions have their 95 % Wilson intervals. All
        figures are of the simulator.
        """
    if data != trials.sha256:
        yield f"The limits and the figure below are of other data now there (`{trials.sha256[:12]}`)."
    yield "## The pair"
    yield _table({name: row for name, row in rows.items() if not name.startswith(joint)})
    yield "## The joint density"
    kept = {name: row for name, row in rows.items() if name.startswith(joint) and name.endswith("/all")}
    yield _table({name.removeprefix(joint): row for name, row in kept.items()})
    yield "## The information limit"
    yield TRUE_FIELDS[reads(checkpoint.network.kind)]
    yield """
        The oracle is a network of the same size that gets the object's true motion in the hand, which is all that a gel
        can show. What it gets wrong is no fault of a tactile network.
        """
    yield _table(limits)
    yield "![Confusion matrix and calibration curve on validation](training.png)"


def _weights(checkpoint: Checkpoint) -> Iterator[torch.Tensor]:
    return (value for name, value in checkpoint.weights.items() if name != "field_scale")


def stress_part(run: Path) -> Iterator[str | Table]:
    """Noise, new objects and the finer physics; nothing where `training stress` has not run."""
    path = run / STRESS_FILE
    if path.exists():
        yield """
            ## Where it was not trained

            Three kinds of trials: validation collisions drawn again with the noise of the cameras multiplied; objects
            that training never saw, in the same ranges of size, grasp and friction; and the training objects in the
            `layer` tier, whose gel couples its nodes and which stands in for another world than the one trained in.
            Calibration is that of the validation split.
            """
        yield _table(json.loads(path.read_text()))


def recipe_part(recipe: Path | None, data_sha256: str) -> tuple[str | Table, ...]:
    """The paper's own recipe in the same simulator; nothing without a run of it, ContractError if it is another's."""
    if recipe is None:
        return ()
    checkpoint = Checkpoint.load(recipe / "checkpoint.pt")
    if checkpoint.network.kind != "alexnet_lstm":
        kind = checkpoint.network.kind
        raise ContractError(f"--recipe {recipe} holds a {kind} network, expected a run of `python -m training recipe`")
    rows = {name: row for name, row in checkpoint.figures.items() if name.endswith("/all") or name.startswith("valid")}
    same = checkpoint.training_data_sha256 == data_sha256
    other = "Those are not the data above, or not all of them, so its rows do not compare with those above."
    imprints = "here pretrained on simulated imprints because no ImageNet weights were at hand"
    text = f"""
        ## The paper's own recipe, same simulator

        Two independent AlexNet-LSTM networks (`python -m training recipe`): frozen convolutions,
        {"of ImageNet" if checkpoint.run.get("imagenet") else imprints}, classes 7 and 8 doubled, Adam. Trained on
        {checkpoint.figures["train/all"]["trials"]:.0f} trials of data `{checkpoint.training_data_sha256[:12]}`, what
        two cores allow in about an hour. The paper had 30,000 real ones and reports 80.5 % on training and 74.4 % on
        validation trials. Its MagnitudeNN has no sigma: coverage is that of one constant spread.
        {"" if same else other}
        """
    return text, _table(rows)


def _table(rows: Rows) -> Table:
    return table(
        rows.items(),
        ("split / object", 0),
        ("trials", "1.trials", ".0f"),
        ("direction", lambda row: wilson(row[1]["accuracy"] * row[1]["trials"], int(row[1]["trials"])), ".1%"),
        ("without near", "1.accuracy_without_near", ".1%"),
        ("chance", "1.chance", ".1%"),
        ("ECE", "1.ece", ".1%"),
        ("wrong side x", "1.wrong_side_x", ".1%"),
        ("MAE x mm", "1.mae_x_mm", ".2f"),
        ("MAE yaw deg", "1.mae_theta_deg", ".2f"),
        ("RMSE x mm", "1.rmse_x_mm", ".2f"),
        ("RMSE yaw deg", "1.rmse_theta_deg", ".2f"),
        ("90 % covers x", "1.coverage90_x", ".1%"),
        ("covers yaw", "1.coverage90_theta", ".1%"),
    )


def _draw(predictions: Predictions, path: Path) -> None:
    """Confusion matrix (shares of each true class) and calibration curve."""
    labels = class_of(predictions.truth.astype(np.float32))
    p = probabilities(predictions.logits, 1.0)
    confidence, accuracy, count = calibration_curve(p, labels)
    with figure.drawing(path, 1, 2, size=(11, 5)) as panels:
        left, right = panels[0]
        names = [entry.name for entry in CLASSES]
        figure.confusion(left, confusion(p, labels), names, "validation trials", "chosen class")
        right.plot([0, 1], [0, 1], color=figure.GREY, linewidth=1)
        right.scatter(confidence, accuracy, s=8 + 200 * count / count.max())
        right.set(xlabel="confidence", ylabel="accuracy", xlim=(0, 1), ylim=(0, 1), title="calibration, area = trials")
