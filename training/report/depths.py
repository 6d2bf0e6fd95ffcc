"""What a network that reads depth gains from pressing further, the coverage of its intervals, and faulty inputs."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from reporting.page import page, publish
from reporting.statistics import number, wilson
from reporting.table import Table, table
from service.contract import ContractError
from training.adapt.stages import trainer_of
from training.config import RunConfig, pin
from training.data.dataset import open_source
from training.data.faults import SHIFTS
from training.data.pressed import Pressed
from training.data.reading import decisions, load
from training.fit.checkpoint import Checkpoint
from training.fit.train import Trainer
from training.metrics.figures import Predictions, figures, probabilities
from training.networks.pressing import DECISION_STEPS, STEP_MM, STEPS, PressingNetwork
from training.report.cameras import by_camera, camera_table
from training.report.pressed_oracle import STAGE, oracle_rows

Rows = dict[str, dict[str, float]]
MOST = 4000
HELD = ("validation", "test")
DECILES = 10
SURE = (0.6, 0.7, 0.8, 0.9)
"""Probabilities of the likeliest direction from which a decision might be made at once."""
UNTOLD = (1, 2, 3)
"""Conditions of `CONDITIONS` that a cell need not know: grasp height, grip and shear reach."""


def write_depths(run: Path, out: Path) -> Path:
    """Write ``<out>/depths.md`` and ``.json`` of a finished run; ContractError if it is none, or reads no depth."""
    try:
        config = RunConfig.model_validate_json((run / "config.json").read_text())
    except (OSError, ValueError) as error:
        raise ContractError(f"{run} is not the folder of a training run: no valid config.json") from error
    checkpoint = Checkpoint.load(run / "checkpoint.pt")
    torch.set_num_threads(config.threads)
    samples = load(config.data, config.network.kind)
    if not isinstance(samples, Pressed):
        raise ContractError(f"{run} holds a {config.network.kind} network, expected one that reads steps of depth")
    trainer = trainer_of(checkpoint.build(), samples)
    data: dict[str, Any] = {"depths": by_depth(trainer, checkpoint), "sure": by_sureness(trainer, checkpoint)}
    data["reach"] = by_reach(trainer, checkpoint)
    source, oracle = open_source(config.data.path), run / "oracle"
    oracle.mkdir(exist_ok=True)
    pin(oracle, STAGE, samples.sha256)
    limit = oracle_rows(source, oracle)
    data["cameras"] = by_camera(trainer, checkpoint.scales, open_source(config.data.path))
    data["limit"] = {f"{split}, true motion": limit[f"{split}/all"] for split in HELD if f"{split}/all" in limit}
    if checkpoint.pressing and checkpoint.pressing.strangeness_limit:
        data["strange"] = faulty_inputs(trainer, checkpoint.pressing.strangeness_limit)
    publish(out, "depths", page(*_parts(checkpoint, samples.sha256, data)), data)
    return out / "depths.md"


def _held(trainer: Trainer, split: str) -> NDArray[np.int64]:
    return trainer.trials.of(split)[:MOST]


def _held_out(trainer: Trainer) -> list[tuple[str, NDArray[np.int64]]]:
    """The held-out splits that have decisions, with their indices."""
    return [(split, chosen) for split in HELD if len(chosen := _held(trainer, split))]


def by_depth(trainer: Trainer, checkpoint: Checkpoint) -> Rows:
    """Figures after each step of depth, of both held-out splits; the last also with nothing told."""
    rows: Rows = {}
    for split, chosen in _held_out(trainer):
        for steps in range(2, STEPS, 2):
            predictions = replace(trainer, most_steps=steps).predict(chosen, pictures=False)
            rows[f"{split}, {steps * STEP_MM:.1f} mm"] = figures(predictions.rescaled(checkpoint.scales))
        untold = replace(trainer, trials=_untold(trainer.trials)).predict(chosen, pictures=False)
        rows[f"{split}, {DECISION_STEPS * STEP_MM:.1f} mm, nothing told"] = figures(untold.rescaled(checkpoint.scales))
    return rows


def by_sureness(trainer: Trainer, checkpoint: Checkpoint) -> Rows:
    """Figures of deciding at the first step that is sure enough, with ``saved``: the share of steps not pressed."""
    rows: Rows = {}
    for split, chosen in _held_out(trainer):
        length = decisions(trainer.trials, chosen, None, pictures=False).length
        assert length is not None
        predictions = [
            replace(trainer, most_steps=steps).predict(chosen, pictures=False).rescaled(checkpoint.scales)
            for steps in range(1, DECISION_STEPS + 1)
        ]
        full = length.numpy().clip(max=DECISION_STEPS)
        for sure in SURE:
            steps = np.minimum(
                first_sure([probabilities(each.logits, 1.0).max(-1) for each in predictions], sure), full
            )
            row = figures(_after_steps(predictions, steps))
            rows[f"{split}, {sure:.1f}"] = row | {"saved": float(1.0 - steps.sum() / full.sum())}
    return rows


def first_sure(confidences: Sequence[NDArray[np.float64]], sure: float) -> NDArray[np.int64]:
    """Steps [N] to the first confidence that is ``sure``, of two steps at least; all steps where none is."""
    enough = np.array(confidences)[1:-1] >= sure
    return np.where(enough.any(0), enough.argmax(0) + 2, len(confidences))


def _after_steps(predictions: Sequence[Predictions], steps: NDArray[np.int64]) -> Predictions:
    """Of each trial what was predicted after its own number of steps."""
    rows = np.arange(len(steps))
    picked = {
        name: np.array([getattr(each, name) for each in predictions])[steps - 1, rows]
        for name in ("logits", "error", "log_sigma")
    }
    return replace(predictions[-1], **picked)


def _untold(trials: object) -> Pressed:
    assert isinstance(trials, Pressed)
    conditions = trials.conditions.copy()
    conditions[:, UNTOLD] = 0.0
    return replace(trials, conditions=conditions)


def by_reach(trainer: Trainer, checkpoint: Checkpoint) -> Rows:
    """Figures by decile of the true shear reach, of all held-out decisions; nothing where no reach is known."""
    trials = trainer.trials
    assert isinstance(trials, Pressed)
    chosen = np.concatenate([_held(trainer, "validation"), _held(trainer, "test")])
    reach_mm = trials.reach[chosen]
    if not (reach_mm > 0).all():
        return {}
    edges = np.quantile(reach_mm, np.linspace(0, 1, DECILES + 1))
    predictions = trainer.predict(chosen, pictures=False).rescaled(checkpoint.scales)
    place = np.digitize(reach_mm, edges[1:-1])
    return {
        f"{edges[decile]:.2f} .. {edges[decile + 1]:.2f} mm": figures(predictions.take(place == decile))
        for decile in range(DECILES)
        if (place == decile).any()
    }


def faulty_inputs(trainer: Trainer, limit: float) -> Rows:
    """How well strangeness tells each fault from usual decisions (1 always, 0.5 not at all), and the share refused."""
    network = trainer.network
    assert isinstance(network, PressingNetwork)
    steps = trainer.decided_steps(_held(trainer, "validation"))
    moved, visible = steps[:, :, :2], steps[:, :, 2:]

    def strangeness(shifted: Tensor) -> NDArray[np.float32]:
        with torch.inference_mode():
            each: Tensor = network.strangeness(network.encode(torch.cat([shifted, visible], 2)))
        return each[:, 0].numpy()

    usual = strangeness(moved)
    shown = {"none": usual} | {name: strangeness(shift(moved)) for name, shift in SHIFTS.items()}
    return {
        name: {"auroc": auroc(usual, each), "refused": float((each > limit).mean()), "decisions": len(each)}
        for name, each in shown.items()
    }


def auroc(low: NDArray[np.float32], high: NDArray[np.float32]) -> float:
    """Probability that one of ``high`` exceeds one of ``low``; ties count half."""
    order = np.sort(low)
    below, upto = np.searchsorted(order, high, "left"), np.searchsorted(order, high, "right")
    return float((below + upto).mean() / (2 * len(low)))


def _parts(checkpoint: Checkpoint, measured_sha256: str, data: dict[str, Any]) -> Iterator[str | Table]:
    depth = f"{DECISION_STEPS * STEP_MM:.1f} mm"
    right = [(split, data["depths"].get(f"{split}, {depth}")) for split in HELD]
    shares = " and ".join(f"{number(row['accuracy'], '.1%')} on `{split}`" for split, row in right if row)
    yield f"""
        # What pressing further reveals

        After {depth} of pressing, the network has the direction right in {shares}.

        Written by `python -m training depths`. Network `{checkpoint.name}`, trained on data
        `{checkpoint.training_data_sha256[:12]}` at commit `{checkpoint.git_commit[:12]}` and measured on data
        `{measured_sha256[:12]}`; all figures are simulated. Each decision uses a camera of another rate, the tracker's
        error, and gap width, grasp height, grip and shear reach as a cell states them. `test` holds cells from other
        draws than those of the training. Coverage on `validation` at {depth} holds by construction: it was calibrated
        there. Shares have 95 % Wilson intervals.
        """
    yield _table(data["depths"])
    yield """
        ## Deciding early

        The same decisions, as soon as the likeliest direction reaches the probability in the first column. *Saved*: the
        share of the pressing that this avoids. A cell presses [0.75 mm as
        shipped](decisions/0079-the-depth-of-a-decision.md).
        """
    yield _table(data["sure"], ("saved", "1.saved", ".1%"), first="sure")
    yield """
        ## Upper bound

        A network of the same size decides after 1.2 mm by the true motion of the object in the hand and the exact
        conditions: a perfect reading of the gel would tell it no more. Many errors move an object alike.
        """
    yield _table(data["limit"])
    yield from _held_out_parts(data)


def _held_out_parts(data: dict[str, Any]) -> Iterator[str | Table]:
    """By camera, by reach, and with faults; each where the data allow it."""
    if data["cameras"]:
        yield """
            ## By camera and speed

            Presses of `test`. The first rows read the same presses, slower than 24 mm/s, at each rate. The last rows
            are slow and quick presses in other cells, read at 60 frames/s. Differences are of pairs.
            """
        yield camera_table(data["cameras"])
    if data["reach"]:
        yield "## By shear reach, held-out decisions"
        yield _table(data["reach"], first="shear reach")
    if "strange" in data:
        yield """
            ## Detection of faulty inputs

            Validation decisions, with one fault each. *AUROC*: the probability that strangeness is higher with the
            fault than without it. *Refused*: the share above the card's limit. Swapped fingers look like another valid
            error of the object: no single decision reveals them.
            """
        yield table(
            data["strange"].items(),
            ("fault", 0),
            ("AUROC", lambda row: row[1]["auroc"] if row[0] != "none" else None, ".3f"),
            ("refused", lambda row: wilson(row[1]["refused"] * row[1]["decisions"], int(row[1]["decisions"])), ".1%"),
        )


def _table(rows: Rows, *more: tuple[str, str, str], first: str = "pressed") -> Table:
    return table(
        rows.items(),
        (first, lambda row: row[0].replace("nothing told", "no conditions given")),
        *more,
        ("decisions", "1.trials", ".0f"),
        ("direction", lambda row: wilson(row[1]["accuracy"] * row[1]["trials"], int(row[1]["trials"])), ".1%"),
        ("MAE x mm", "1.mae_x_mm", ".2f"),
        ("MAE yaw deg", "1.mae_theta_deg", ".2f"),
        ("90 % coverage x", "1.coverage90_x", ".1%"),
        ("90 % coverage yaw", "1.coverage90_theta", ".1%"),
    )
