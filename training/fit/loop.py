"""One training loop for every stage: progress, cosine schedule, early stopping, checkpoint and resume."""

import json
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from service.contract import ContractError
from training.config import StageConfig
from training.fit.checkpoint import save_whole

WARM_UP = 0.05
MAX_GRADIENT = 1.0


@dataclass
class Stage:
    """The subject of a stage.

    ``batches`` of an epoch, ``loss`` of one batch, ``validate`` -> scalars; the lowest ``score`` wins. ``basis_of`` are
    files beside its state that rest on its result: removed where it is trained on, so that they are made anew.
    """

    name: str
    config: StageConfig
    parameters: list[nn.Parameter]
    batches: Callable[[np.random.Generator], Iterable[Any]]
    batches_per_epoch: int
    loss: Callable[[Any], Tensor]
    validate: Callable[[], dict[str, float]]
    basis_of: tuple[str, ...] = ()


@dataclass
class _Progressed:
    epoch: int = 0
    best: float = math.inf
    best_epoch: int = -1
    best_state: dict[str, Tensor] = field(default_factory=dict)
    minutes: float = 0.0

    def over(self, config: StageConfig) -> bool:
        """Whether the stage has ended, in this call or in an earlier one."""
        waited = self.epoch - self.best_epoch > config.patience
        return self.epoch >= config.epochs or waited or self.minutes > config.max_minutes


def _rate(step: int, total: int) -> float:
    warm = max(1, int(WARM_UP * total))
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, (step - warm) / max(1, total - warm))))


def fit(network: nn.Module, stage: Stage, folder: Path, seed: int) -> dict[str, float]:
    """Train one stage and leave ``network`` at its best epoch; resumes from ``folder`` if it holds this stage.

    Appends a JSON line per epoch to ``log.jsonl`` there. A stage that was cut by `max_minutes` goes on if they are more
    now. Returns the scalars of the best validation and ``epochs``, those trained in all calls. Raises ContractError on
    a non-finite loss or a foreign checkpoint.
    """
    config = stage.config
    optimiser = torch.optim.AdamW(stage.parameters, lr=config.learning_rate, weight_decay=config.weight_decay)
    path = folder / f"{stage.name}.resume.pt"
    total = config.epochs * stage.batches_per_epoch
    schedule = LambdaLR(optimiser, lambda step: _rate(step, total))
    at = _resume(path, network, optimiser, schedule)
    started = time.monotonic() - 60 * at.minutes
    scalars: dict[str, float] = {}
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"), TimeRemainingColumn())
    with Progress(*columns) as progress:
        task = progress.add_task(stage.name, total=total, completed=at.epoch * stage.batches_per_epoch, note="")
        while not at.over(config):
            for name in stage.basis_of:
                (folder / name).unlink(missing_ok=True)
            rng = np.random.default_rng([seed, at.epoch])
            torch.manual_seed(seed * 1000 + at.epoch)
            loss = _epoch(network, stage, optimiser, schedule, rng, lambda: progress.advance(task))
            scalars = {"loss": loss, **_validate(network, stage), "minutes": (time.monotonic() - started) / 60}
            with (folder / "log.jsonl").open("a") as log:
                log.write(json.dumps({"stage": stage.name, "epoch": at.epoch, **scalars}) + "\n")
            progress.update(task, note=" ".join(f"{name} {value:.3f}" for name, value in scalars.items()))
            _keep_best(at, scalars, network)
            at.epoch, at.minutes = at.epoch + 1, scalars["minutes"]
            _save(path, network, optimiser, schedule, at)
    if at.minutes > config.max_minutes and at.epoch < config.epochs:
        after = f"after {at.epoch} of {config.epochs} epochs: max_minutes = {config.max_minutes:g}"
        print(f"{stage.name}: ENDED EARLY {after}")
    if at.best_state:
        network.load_state_dict(at.best_state)
    return _validate(network, stage) | {"epochs": at.epoch}


def _epoch(
    network: nn.Module,
    stage: Stage,
    optimiser: Optimizer,
    schedule: LambdaLR,
    rng: np.random.Generator,
    advance: Callable[[], None],
) -> float:
    network.train()
    losses = []
    for batch in stage.batches(rng):
        loss = stage.loss(batch)
        if not torch.isfinite(loss):
            raise ContractError(f"stage {stage.name}: the loss is {loss.item()}, expected a finite number")
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(stage.parameters, MAX_GRADIENT)
        optimiser.step()
        schedule.step()
        losses.append(float(loss.detach()))
        advance()
    return float(np.mean(losses))


def _validate(network: nn.Module, stage: Stage) -> dict[str, float]:
    network.eval()
    with torch.inference_mode():
        return stage.validate()


def _keep_best(at: _Progressed, scalars: dict[str, float], network: nn.Module) -> None:
    if scalars["score"] < at.best:
        at.best, at.best_epoch = scalars["score"], at.epoch
        at.best_state = {name: value.detach().clone() for name, value in network.state_dict().items()}


def _save(path: Path, network: nn.Module, optimiser: Optimizer, schedule: LambdaLR, at: _Progressed) -> None:
    save_whole(
        path,
        {
            "network": network.state_dict(),
            "optimiser": optimiser.state_dict(),
            "schedule": {"last_epoch": schedule.last_epoch},
            **vars(at),
        },
    )


def _resume(path: Path, network: nn.Module, optimiser: Optimizer, schedule: LambdaLR) -> _Progressed:
    if not path.exists():
        return _Progressed()
    try:
        stored = torch.load(path, weights_only=True)
    except Exception as error:  # torch raises pickle, zip and end-of-file errors of many kinds on a damaged file
        raise ContractError(f"{path} cannot be read ({type(error).__name__}); remove it to begin this stage") from error
    try:
        network.load_state_dict(stored["network"])
        optimiser.load_state_dict(stored["optimiser"])  # restores its learning rate, too
        schedule.last_epoch = stored["schedule"]["last_epoch"]
        return _Progressed(**{one.name: stored[one.name] for one in fields(_Progressed)})
    except (RuntimeError, KeyError, ValueError) as error:
        raise ContractError(f"{path} holds another architecture, expected this run's") from error
