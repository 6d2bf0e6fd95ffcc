"""Training of the compact pair in three stages; the result is a checkpoint with calibration and held-out figures.

1. front: pictures -> true marker field changes (dense supervision, few pictures needed). 2. trunk: true fields with the
front's own error added -> decision (every trial, no picture needed). 3. tune: pictures -> decision, through both.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import JsonValue
from torch import Tensor
from torch.nn import functional

from reporting.machine import commit
from service.contract import ContractError, Sensor
from service.contract.model_card import Expectations
from training.config import RunConfig, alone_in, pin, refuse_another
from training.data.batches import Batch, frame_pairs
from training.data.dataset import SPLITS, Source, Trials
from training.data.labels import CLASSES
from training.data.pressed import Pressed
from training.data.reading import Samples, decisions, epoch, load, refuse_useless
from training.fit.checkpoint import Checkpoint
from training.fit.device import on_device
from training.fit.expectations import of_errors
from training.fit.loop import Stage, fit
from training.fit.usual import learn_usual
from training.metrics.figures import Predictions, Sample, Scales, by_split, figures
from training.metrics.joint import Densities
from training.networks import build, network_class
from training.networks.decider import Decider
from training.networks.pressing import DECISION_STEPS, FEWEST_STEPS

EVALUATION_BATCH = 32
MOST_SCORED = 2000


@dataclass
class Trainer:
    """The objects of one run."""

    config: RunConfig
    trials: Samples
    network: Decider
    front_error: Tensor
    most_steps: int = DECISION_STEPS  # steps of depth of a decision, at most

    def normalised(self, batch: Batch) -> Tensor:
        """True field changes in the network's units."""
        return self.network.normalised(batch.fields)

    def decision_loss(self, fields: Tensor, batch: Batch) -> Tensor:
        """Cross entropy of the class, and negative log likelihood of the error under one Gaussian and the mixture."""
        network, weight = self.network, self.config.loss
        state, label, truth = self._asked(fields, batch)
        direction = functional.cross_entropy(network.logits(state), label)
        error, log_sigma = network.error(state)
        z = (error - truth) * torch.exp(-log_sigma)
        magnitude = (0.5 * z.square() + log_sigma).mean()
        density = network.density.negative_log_likelihood(state, truth).mean()
        return direction + weight.magnitude * magnitude + weight.density * density

    def _asked(self, fields: Tensor, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """The states to train on, with label and error of each: the last of a decision; for steps of depth, all."""
        if batch.length is None:
            return self.network.read_fields(fields, batch.geometry), batch.label, batch.error
        states = self.network.read_steps(fields, batch.geometry)
        asked = torch.arange(states.shape[1], device=states.device) < batch.length[:, None]
        row, step = torch.nonzero(asked, as_tuple=True)
        return states[row, step], batch.label[row], batch.error[row]

    def front_loss(self, pair: tuple[Tensor, Tensor, Tensor]) -> Tensor:
        """Mean square error of the field change, in normalised units."""
        frame, reference, change = (part.to(self.network.device) for part in pair)
        assert self.network.front is not None
        return functional.mse_loss(self.network.front(frame, reference), self._scaled(change))

    def trunk_loss(self, batch: Batch) -> Tensor:
        """Decision loss on true fields with reading errors added."""
        fields = self.network.disturbed(self.normalised(batch), self.front_error)
        return self.decision_loss(fields, batch)

    def tune_loss(self, batch: Batch) -> Tensor:
        """Decision loss on pictures, with the field still supervised by the ground truth."""
        assert batch.drawn is not None
        fields = self.network.read_drawn(batch.drawn)
        held = functional.mse_loss(fields, self.normalised(batch))
        return self.decision_loss(fields, batch) + self.config.loss.field * held

    def _scaled(self, change: Tensor) -> Tensor:
        return change * self.network.field_scale[:, None, None]

    def states(self, chosen: NDArray[np.int64], *, pictures: bool) -> Tensor:
        """Decision states [N, state_size] of trials, unaugmented; from pictures or from true fields."""
        states = []
        self.network.eval()
        with torch.inference_mode():
            for start in range(0, len(chosen), EVALUATION_BATCH):
                part = chosen[start : start + EVALUATION_BATCH]
                batch = decisions(self.trials, part, None, pictures=pictures).to(self.network.device)
                fields = self.normalised(batch) if batch.drawn is None else self.network.read_drawn(batch.drawn)
                states.append(self._last(fields, batch))
        return torch.cat(states)

    def _last(self, fields: Tensor, batch: Batch) -> Tensor:
        if batch.length is None:
            return self.network.read_fields(fields, batch.geometry)
        last = batch.length.clamp(max=self.most_steps) - 1
        return self.network.read_steps(fields, batch.geometry)[torch.arange(len(last)), last]

    def decided_steps(self, chosen: NDArray[np.int64], rng: np.random.Generator | None = None) -> Tensor:
        """Normalised steps [N, 2, 3, rows, columns], one of each decision: in turn of those at which it may be made."""
        batch = decisions(self.trials, chosen, rng, pictures=False)
        assert batch.length is not None
        rows = torch.arange(len(chosen))
        after = FEWEST_STEPS + rows % (DECISION_STEPS - FEWEST_STEPS + 1)
        return self.normalised(batch)[rows, torch.minimum(after, batch.length) - 1]

    def predict(self, chosen: NDArray[np.int64], *, pictures: bool) -> Predictions:
        state = self.states(chosen, pictures=pictures)
        with torch.inference_mode():
            outputs = (self.network.logits(state), *self.network.error(state))
        logits, error, log_sigma = (value.double().cpu().numpy() for value in outputs)
        truth = self.trials.error[chosen].astype(np.float64)
        return Predictions(logits, error, log_sigma, truth, self.trials.objects[chosen])

    def predict_density(self, chosen: NDArray[np.int64], *, pictures: bool) -> Densities:
        state = self.states(chosen, pictures=pictures)
        with torch.inference_mode():
            density = self.network.log_density(state).double().cpu().numpy()
        return Densities(density, self.trials.error[chosen], self.trials.objects[chosen])

    def score(self, chosen: NDArray[np.int64], *, pictures: bool) -> dict[str, float]:
        """Validation scalars; ``score`` is the loss with calibrated classes."""
        predictions = self.predict(chosen, pictures=pictures)
        table = figures(predictions.rescaled(predictions.calibration()))
        z = (predictions.error - predictions.truth) * np.exp(-predictions.log_sigma)
        likelihood = float((0.5 * z**2 + predictions.log_sigma).mean())
        kept = {name: table[name] for name in ("accuracy", "nll", "rmse_x_mm", "rmse_theta_deg")}
        return {"score": table["nll"] + self.config.loss.magnitude * likelihood, **kept}

    def front_score(self, chosen: NDArray[np.int64]) -> dict[str, float]:
        """Front's mean square error on validation pictures; also stores the size of its error for the trunk."""
        assert isinstance(self.trials, Trials)
        front, rng = self.network.get_submodule("front"), np.random.default_rng(0)
        pairs = ([part.to(self.network.device) for part in pair] for pair in frame_pairs(self.trials, chosen, 256, rng))
        residual = torch.cat([front(frame, reference) - self._scaled(change) for frame, reference, change in pairs])
        smooth = residual.mean((2, 3))
        self.front_error = torch.stack([(residual - smooth[:, :, None, None]).std((0, 2, 3)), smooth.std(0)])
        errors = self.front_error[0] / self.network.field_scale
        du_um, dv_um = (1e3 * float(error) for error in errors[:2])
        return {"score": float(residual.square().mean()), "du_um": du_um, "dv_um": dv_um}


def train(config: RunConfig, source: Source | None = None) -> Checkpoint:
    """Run all stages, resuming a killed run, and save ``<runs>/<name>/checkpoint.pt``."""
    if not issubclass(network_class(config.network.kind), Decider):
        raise ContractError(f"network.kind is {config.network.kind}, which `python -m training recipe` trains")
    device = on_device(config)
    torch.manual_seed(config.seed)
    folder = config.folder
    folder.mkdir(parents=True, exist_ok=True)
    refuse_another(folder, config)
    trials = load(config.data, config.network.kind, source)
    refuse_useless(trials)
    grounds = trials.sha256 + (_start(config, trials.sensor).weights_sha256() if config.start_from else "")
    pin(folder, config, grounds)  # only now: a mistyped data folder must not claim the run's
    with alone_in(folder):
        return _train(_prepare(config, trials, device), folder)


def _train(trainer: Trainer, folder: Path) -> Checkpoint:
    stages = [stage for stage in _stages(trainer) if stage.config.epochs]
    for stage, split in product(stages, ("train", "validation")):  # before any has trained for hours
        if stage.name != "trunk" and not len(trainer.trials.of(split, rendered=True)):
            raise ContractError(f"stage {stage.name} needs rendered {split} trials; see data.rendered_*")
    epochs: dict[str, JsonValue] = {}
    for stage in stages:
        scalars = fit(trainer.network, stage, folder, trainer.config.seed)
        print(stage.name, {name: round(value, 4) for name, value in scalars.items()})
        epochs[stage.name] = int(scalars["epochs"])
    return _finish(trainer, folder, epochs)


def _prepare(config: RunConfig, trials: Samples, device: torch.device) -> Trainer:
    network: Decider = build(config.network, len(CLASSES), trials.sensor)
    if config.start_from is not None:
        network.load_state_dict(_start(config, trials.sensor).build(config.network).state_dict())
    else:
        _set_scales(network, trials)
    return Trainer(config, trials, network.to(device), torch.full((2, 3), 0.1, device=device))


def _start(config: RunConfig, sensor: Sensor) -> Checkpoint:
    start = Checkpoint.load(Path(config.start_from or ""))
    if start.sensor != sensor:
        raise ContractError(f"start_from {config.start_from} is for sensor {start.sensor}, the data are of {sensor}")
    return start


def _set_scales(network: Decider, trials: Samples) -> None:
    """Normalise the network's inputs by their spread over some training decisions."""
    chosen = trials.of("train")[:: max(1, len(trials.of("train")) // 500)]
    network.set_scales(decisions(trials, chosen, None, pictures=False).fields)


def _stages(trainer: Trainer) -> list[Stage]:
    config, trials, network = trainer.config, trainer.trials, trainer.network
    everything, drawn = trials.of("train"), trials.of("train", rendered=True)
    held, held_drawn = trials.of("validation"), trials.of("validation", rendered=True)
    heads = (network.direction, network.magnitude, network.density)
    decision = [*network.trunk.parameters(), *(p for head in heads for p in head.parameters())]
    trunk = Stage(
        "trunk",
        config.trunk,
        decision,
        batches=lambda rng: epoch(trials, everything, config.trunk.batch, rng, network.device, pictures=False),
        batches_per_epoch=-(-len(everything) // config.trunk.batch),
        loss=trainer.trunk_loss,
        validate=lambda: trainer.score(held, pictures=False),
        basis_of=("tune.resume.pt",),
    )
    if network.front is None or isinstance(trials, Pressed):
        return [trunk]
    front = Stage(
        "front",
        config.front,
        list(network.front.parameters()),
        batches=lambda rng: frame_pairs(trials, drawn, config.front.batch, rng),
        batches_per_epoch=-(-len(drawn) // max(1, config.front.batch // 8)),
        loss=trainer.front_loss,
        validate=lambda: trainer.front_score(held_drawn),
        basis_of=("trunk.resume.pt", "tune.resume.pt"),
    )
    tune = Stage(
        "tune",
        config.tune,
        list(network.parameters()),
        batches=lambda rng: epoch(trials, drawn, config.tune.batch, rng, network.device, pictures=True),
        batches_per_epoch=-(-len(drawn) // config.tune.batch),
        loss=trainer.tune_loss,
        validate=lambda: trainer.score(held_drawn, pictures=True),
    )
    return [front, trunk, tune]


def _finish(trainer: Trainer, folder: Path, epochs: dict[str, JsonValue]) -> Checkpoint:
    """Calibrate on validation, score every split (on pictures where there are any), save; on the CPU, as released."""
    trainer.network.cpu()
    pictures = len(trainer.trials.of("validation", rendered=True)) > 0
    scales, tables = _scored(trainer, trainer.predict, pictures=pictures)
    joint_scales, joint_tables = _scored(trainer, trainer.predict_density, pictures=pictures)
    pressing, expectations = None, Expectations()
    if isinstance(trainer.trials, Pressed):
        pressing = learn_usual(trainer.network, trainer.trials, trainer.decided_steps)
        expectations = of_errors(trainer.trials.error[trainer.trials.of("train")].astype(np.float64), expectations)
    true = "" if pictures or pressing else "fields/"  # true fields do not validate a network that reads pictures
    tables |= {f"joint/{name}": row for name, row in joint_tables.items()}
    checkpoint = Checkpoint(
        name=trainer.config.name,
        network=trainer.config.network,
        weights={name: value.detach().clone() for name, value in trainer.network.state_dict().items()},
        scales=scales,
        joint_scales=joint_scales,
        figures={f"{true}{name}": row for name, row in tables.items()},
        training_data_sha256=trainer.trials.sha256,
        git_commit=commit(),
        run=trainer.config.settings() | {"epochs_trained": epochs},
        sensor=trainer.trials.sensor,
        pressing=pressing,
        expectations=expectations,
    )
    path = folder / "checkpoint.pt"
    checkpoint = checkpoint.known_from(path)
    checkpoint.save(path)
    return checkpoint


def _scored(
    trainer: Trainer, predict: Callable[..., Sample], *, pictures: bool
) -> tuple[Scales, dict[str, dict[str, float]]]:
    """Calibration on all validation trials, and figures by split and object."""
    trials = trainer.trials
    scales = predict(trials.of("validation", rendered=pictures), pictures=pictures).calibration()
    chosen = {split: trials.of(split, rendered=pictures)[:MOST_SCORED] for split in SPLITS}
    samples = {
        split: (predict(rows, pictures=pictures), trials.groups[rows]) for split, rows in chosen.items() if len(rows)
    }
    return scales, by_split(samples, scales)
