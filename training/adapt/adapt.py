"""Choose the stage that suits a cell, on held-out fixtures, and decide whether it may replace the release."""

import hashlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from reporting.machine import commit
from reporting.table import table
from service.contract import ContractError
from training.adapt.frames import Gap, framed
from training.adapt.hindsight import drawn
from training.adapt.objections import chances, losses, to_gain, to_wider
from training.adapt.stages import (
    FOLDS,
    STAGES,
    Rows,
    StageName,
    calibrated,
    fit_around,
    fit_stage,
    folds_of,
    held_out,
    trainer_of,
)
from training.config import DataConfig
from training.data.episodes import LATER, PROBE, Listed, cells_of, read_episodes, recordings_of
from training.data.pressed import Pressed, load_pressed
from training.fit.checkpoint import AS_TRAINED, OWN, Checkpoint
from training.metrics.figures import Predictions, Scales, figures, joined
from training.metrics.joint import Densities

FEWEST = 20
Figures = dict[str, float]
Held = dict[StageName, tuple[Predictions, Densities]]


@dataclass(frozen=True)
class Comparison:
    """Every stage on held-out fixtures, the best of them, and the objections to replacing the release.

    ``known_of``: how many of the compared samples are of probes and of work. ``cells``: how many of the recordings are
    of real cells and of simulated ones, see `cells_of`. ``listed``: how many insertions of a record are there.
    """

    figures: dict[StageName, Figures]
    best: StageName
    objections: tuple[str, ...]
    samples_n: int
    fixtures_n: int
    known_of: dict[str, int] = field(default_factory=dict)
    gap: Gap | None = None
    cells: dict[str, int] = field(default_factory=dict)
    listed: Listed | None = None

    @property
    def accepted(self) -> bool:
        """Whether the best stage may replace the release."""
        return self.best != "released" and not self.objections

    def text(self) -> str:
        """The table and the verdict, for a terminal."""
        rows = [{"stage": stage, **row} for stage, row in self.figures.items()]
        columns = (
            ("stage", "stage"),
            ("negative log likelihood", "likelihood", ".3f"),
            ("direction", "accuracy", ".1%"),
            ("MAE x mm", "mae_x_mm", ".2f"),
            ("MAE yaw deg", "mae_theta_deg", ".2f"),
            ("90 % coverage x", "coverage90_x", ".0%"),
            ("90 % coverage yaw", "coverage90_theta", ".0%"),
        )
        conclusion = f"accepted: {self.best}" if self.accepted else f"the release stays: {'; '.join(self.objections)}"
        compared = " and ".join(f"{count} of {known}" for known, count in self.known_of.items())
        first = f"{self.samples_n} first attempts of {self.fixtures_n} fixtures ({compared})"
        held = f"{first}, every figure on fixtures held out"
        shown = (table(rows, *columns).text(), held) if rows else ()
        return "\n".join((*shown, *self._recordings_text(), *self._gap_text(), conclusion))

    def _recordings_text(self) -> Iterable[str]:
        if self.listed:
            yield self.listed.text()
        if self.cells:
            named = {"real": "of a real cell", "simulated": "of a simulated cell", "not stated": "do not say"}
            yield f"recordings: {', '.join(f'{count} {named[kind]}' for kind, count in self.cells.items())}"

    def _gap_text(self) -> Iterable[str]:
        if self.gap and self.gap.probes_n:
            x, yaw = (f"{at:+.1f} +- {sigma:.1f}" for at, sigma in zip(self.gap.at, self.gap.sigma, strict=True))
            yield f"the gap is at x {x} mm, yaw {yaw} deg in the frame that the arm was taught"


def adapt(
    recordings: Path,
    start: Path,
    out: Path,
    *,
    around: Path | None = None,
    record: Path | None = None,
    stages: Iterable[StageName] = STAGES,
    seed: int = 0,
) -> Comparison:
    """Fit the released checkpoint ``start`` to ``recordings``; write ``out/checkpoint.pt`` if it is accepted.

    If it is not, the checkpoint of an earlier run becomes ``earlier.pt``: it must not pass for this one's.
    ``around``: a dataset of presses simulated around the cell, for the stage of that name. ``record``: of the cell's
    commissioning, see `read_episodes`. Raises ContractError where there is nothing to learn from, where the checkpoint
    reads no depth, or where it was adapted to some of these recordings or does not say to which: no figure would be on
    held-out ones. Nor is ``start`` replaced: the next adaptation begins with it.
    """
    release, written = Checkpoint.load(start), out / "checkpoint.pt"
    if written.is_file() and written.samefile(start):
        raise ContractError(
            f"{out} holds the release, which the adapted checkpoint would replace; expected another --out"
        )
    if release.pressing is None:
        raise ContractError(f"{start} holds a {release.network.kind} network, expected one that reads steps of depth")
    samples = read_episodes(recordings, release.sensor, record)
    if known_n := len(set(_learnt_from(release, start)) & set(_digests(samples))):
        raise ContractError(f"{start} was adapted to {known_n} of these recordings; adapt the release that it is from")
    predicted = trainer_of(release.build(), samples).predict(np.arange(len(samples)), pictures=False)
    samples, gap = framed(samples, predicted.error)
    samples = drawn(release, samples, seed)
    presses = presses_around(around, release, out) if around else None
    chosen = tuple(stage for stage in stages if stage != "around" or presses)
    held = hold_out(release, samples, chosen, seed, presses)
    cells, (_, listed) = cells_of(recordings, samples), recordings_of(recordings, record)
    comparison = replace(compare(release, samples, held, seed), gap=gap, cells=cells, listed=listed)
    if comparison.accepted:
        _fitted(comparison, release, samples, held[comparison.best], seed, presses).save(written)
    elif written.is_file():
        written.replace(written.with_name("earlier.pt"))
    return comparison


def presses_around(path: Path, release: Checkpoint, out: Path) -> Pressed:
    """The presses of a dataset as training samples, kept below ``out``. Raises ContractError."""
    presses = load_pressed(DataConfig(path=str(path), cache=str(out / "cache")))
    if presses.sensor != release.sensor:
        raise ContractError(f"{path} is of sensor {presses.sensor}, the release of {release.sensor}")
    return presses


def hold_out(
    release: Checkpoint, samples: Pressed, stages: tuple[StageName, ...], seed: int, presses: Pressed | None = None
) -> Held:
    """Each stage's predictions on held-out fixtures; empty if there are too few samples."""
    if not _enough(samples.groups[compared_on(samples)]):
        return {}
    return {stage: held_out(stage, release, samples, seed, presses) for stage in dict.fromkeys(("released", *stages))}


def compared_on(samples: Pressed) -> NDArray[np.bool_]:
    """[N]: the samples that networks are compared and calibrated on: probes, or all first attempts if they are too few.

    The error of a probe is known. That of work is in part the release's own opinion, see `drawn`.
    """
    probes = samples.objects == PROBE
    return np.asarray(probes if _enough(samples.groups[probes]) else samples.objects != LATER)


def _enough(groups: NDArray[np.str_]) -> bool:
    """Whether attempts of these fixtures can be divided into fixtures to fit and fixtures held out."""
    return len(groups) >= FEWEST and len(np.unique(groups)) >= FOLDS


def compare(release: Checkpoint, samples: Pressed, held: Held, seed: int) -> Comparison:
    """Compare all stages' predictions on held-out fixtures; every count is compared with the release's in pairs.

    The best is the likeliest stage without objections, else calibration if the release is proven too sure; if it is
    not, the likeliest.
    """
    among = compared_on(samples)
    groups = samples.groups[among]
    fixtures_n = len(np.unique(groups))
    known_of = {
        known: int(count) for known, count in zip(*np.unique(samples.objects[among], return_counts=True), strict=True)
    }
    if not held:
        few = f"{len(groups)} first attempts of {fixtures_n} fixtures, expected {FEWEST} of {FOLDS} at least"
        return Comparison({}, "released", (few, "probe more"), len(groups), fixtures_n, known_of)
    predictions = {stage: pair.take(among) for stage, (pair, _) in held.items()}
    folds = folds_of(groups, seed)
    fair = {stage: _fair(stage, release.scales, one, folds) for stage, one in predictions.items()}
    loss = {stage: float(losses(one).mean()) for stage, one in fair.items()}
    before, rivals = fair["released"], tuple(stage for stage in fair if stage not in ("released", "calibration"))
    chance = chances(rivals, int((samples.objects == PROBE).sum()))
    likelier = sorted((stage for stage in rivals if loss[stage] < loss["released"]), key=loss.__getitem__)
    against: dict[StageName, tuple[str, ...]]
    against = {stage: tuple(to_gain(before, fair[stage], groups, seed, chance[stage])) for stage in likelier}
    if "calibration" in fair:
        against["calibration"] = tuple(to_wider(before, groups))
    fallback: StageName = likelier[0] if likelier else "released"
    best = next((stage for stage in against if not against[stage]), fallback)
    objections = against.get(best, ("no stage is likelier than the release",))
    described = {stage: {**figures(one), "likelihood": loss[stage]} for stage, one in fair.items()}
    return Comparison(described, best, objections, len(groups), fixtures_n, known_of)


def _fair(stage: StageName, scales: Scales, predictions: Predictions | Densities, folds: list[Rows]) -> Predictions:
    """Calibrated predictions, each fold of the fixtures by the others: no fit calibrates its own samples."""
    if stage == "released":
        return predictions.rescaled(scales)
    parts = []
    for held in folds:
        mine = np.isin(np.arange(len(predictions.truth)), held)
        parts.append(predictions.take(mine).rescaled(calibrated(stage, scales, predictions.take(~mine))))
    return joined(parts, [np.sort(held) for held in folds])


def _fitted(
    comparison: Comparison,
    release: Checkpoint,
    samples: Pressed,
    held: tuple[Predictions, Densities],
    seed: int,
    presses: Pressed | None,
) -> Checkpoint:
    """The release after the accepted stage on all samples, calibrated on the predictions ``held`` out."""
    among = compared_on(samples)
    pair, joint = (predictions.take(among) for predictions in held)
    folds = folds_of(samples.groups[among], seed)
    around = comparison.best == "around"
    rows = np.arange(len(samples))
    network = fit_around(release, presses, seed) if around else fit_stage(comparison.best, release, samples, rows, seed)
    lineage: dict[str, JsonValue] = {
        "from": release.weights_sha256(),
        "attempts": samples.sha256,
        "attempts_n": len(samples),
        "recordings": [*_learnt_from(release, Path(release.name)), *_digests(samples)],
        "cells": dict(comparison.cells),
        "fixtures_n": comparison.fixtures_n,
        "stage": comparison.best,
        "presses": presses.sha256 if around and presses else None,
        "before": dict(comparison.figures["released"]),
        "after": dict(comparison.figures[comparison.best]),
    }
    return replace(
        release,
        name=f"{release.name}-adapted",
        weights={name: value.detach().clone() for name, value in network.state_dict().items()},
        scales=calibrated(comparison.best, release.scales, pair),
        joint_scales=calibrated(comparison.best, release.joint_scales, joint),
        figures={
            OWN: dict(comparison.figures[comparison.best]),
            f"joint/{OWN}": figures(_fair(comparison.best, release.joint_scales, joint, folds)),
            AS_TRAINED: release.as_trained,
        },
        git_commit=commit(),
        run={**release.run, "adapted": lineage},
    )


def _learnt_from(release: Checkpoint, path: Path) -> list[str]:
    """Digests of the recordings that a checkpoint was adapted to, empty for one that is as trained."""
    adapted = release.run.get("adapted")
    if adapted is None:
        return []
    listed = adapted.get("recordings") if isinstance(adapted, dict) else None
    if not isinstance(listed, list):
        raise ContractError(
            f"{path} was adapted by an earlier version, which did not note to which recordings;"
            " adapt the release that it is from"
        )
    return [str(one) for one in listed]


def _digests(samples: Pressed) -> list[str]:
    return [hashlib.sha256(name.encode()).hexdigest()[:12] for name in np.unique(samples.groups).tolist()]


def report(comparison: Comparison) -> dict[str, object]:
    """The verdict as plain data."""
    return {**asdict(comparison), "accepted": comparison.accepted}
