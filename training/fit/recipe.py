"""The paper's own recipe, the baseline: two independent AlexNet-LSTM networks.

Convolutions are frozen: ImageNet's if a state dict is given, otherwise pretrained here on simulated imprints (from a
difference frame to the gel's motion). Their features are computed once and cached; the fully connected layers and the
LSTM are then trained with Adam. Classes 7 and 8 are doubled with random crops, as in the paper.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import JsonValue
from torch import Tensor, nn
from torch.nn import functional

from reporting.machine import commit
from training.config import JITTER, RecipeConfig, StageConfig, alone_in, pin, refuse_another
from training.data.dataset import SPLITS, Source, data_sha256, load_table, open_source, refuse_empty_splits
from training.data.labels import CLASSES, class_of
from training.data.recipe_data import Rows, chosen_trials, decision_frames, load_rows
from training.fit.checkpoint import Checkpoint
from training.fit.device import on_device
from training.fit.loop import Stage, fit
from training.metrics.figures import Predictions, by_split
from training.networks.alexnet import FEATURES, AlexNetLstm, AlexNetPair, difference_images, load_imagenet
from training.networks.settings import FRAMES_PER_DECISION, NetworkConfig

NETWORK = NetworkConfig(kind="alexnet_lstm")


def train_recipe(config: RecipeConfig, source: Source | None = None) -> Checkpoint:
    """Run the recipe, or resume it; raises ContractError on data or weights that do not fit."""
    device = on_device(config)
    torch.manual_seed(config.seed)
    source = open_source(config.data) if source is None else source
    folder = config.folder
    folder.mkdir(parents=True, exist_ok=True)
    refuse_another(folder, config)
    digest = data_sha256(source)
    table = load_table(source, Path(config.cache) / digest[:16], len(source))
    refuse_empty_splits(table["split"])
    pin(folder, config, digest)
    with alone_in(folder):
        return _train(config, source, table, digest, device)


def _train(
    config: RecipeConfig, source: Source, table: dict[str, NDArray[Any]], digest: str, device: torch.device
) -> Checkpoint:
    pair = AlexNetPair(NETWORK, len(CLASSES)).to(device)
    epochs: dict[str, JsonValue] = {}
    if config.imagenet:
        for network in (pair.direction, pair.magnitude):
            load_imagenet(network, Path(config.imagenet))
    else:
        epochs["convolutions"] = _pretrain(config, source, table, pair)
    rows = load_rows(config, source, table, pair.direction)
    epochs["direction"] = _fit_heads(config, "direction", pair.direction, rows)
    epochs["magnitude"] = _fit_heads(config, "magnitude", pair.magnitude, rows)
    return finish(config, pair.cpu(), rows, digest, epochs)


# ---- convolutions --------------------------------------------------------------------------------------------------


class _FieldReader(nn.Module):
    """Convolutions with a linear read-out of the marker field, for pretraining."""

    def __init__(self, network: AlexNetLstm, size: int) -> None:
        super().__init__()
        self.features = network.alexnet.features
        self.read_out = nn.Linear(FEATURES, size)

    def forward(self, images: Tensor) -> Tensor:
        field: Tensor = self.read_out(self.features(images).flatten(1))
        return field


def _pretrain(config: RecipeConfig, source: Source, table: dict[str, NDArray[Any]], pair: AlexNetPair) -> int:
    """Difference frame -> change of the marker field, on training trials; both networks then start from the result.

    Returns the number of epochs.
    """
    reader = _FieldReader(pair.direction, int(np.prod(table["fields"].shape[3:]))).to(pair.direction.device)
    chosen = chosen_trials(table, "train", config.pretraining_trials)
    held = chosen_trials(table, "validation", max(8, config.pretraining_trials // 10))
    fields = table["fields"][chosen].astype(np.float32)
    scale = torch.from_numpy(1.0 / np.maximum((fields - fields[:, :1]).std((0, 1, 2, 3, 4)), 1e-4))

    def examples(trials: NDArray[np.int64]) -> Iterator[tuple[Tensor, Tensor]]:
        for start in range(0, len(trials), 2):
            parts = [_field_examples(source, table, int(trial), scale) for trial in trials[start : start + 2]]
            images, change = (torch.cat(column).to(pair.direction.device) for column in zip(*parts, strict=True))
            yield images, change

    def validate() -> dict[str, float]:
        errors = [functional.mse_loss(reader(images), target) for images, target in examples(held)]
        return {"score": float(torch.stack(errors).mean())}

    stage = Stage(
        "convolutions",
        config.convolutions,
        list(reader.parameters()),
        batches=lambda rng: examples(rng.permutation(chosen)),
        batches_per_epoch=-(-len(chosen) // 2),
        loss=lambda example: functional.mse_loss(reader(example[0]), example[1]),
        validate=validate,
        basis_of=("features.done", "direction.resume.pt", "magnitude.resume.pt"),
    )
    print("convolutions", scalars := fit(reader, stage, config.folder, config.seed))
    pair.magnitude.alexnet.features.load_state_dict(pair.direction.alexnet.features.state_dict())
    return int(scalars["epochs"])


def _field_examples(source: Source, table: dict[str, NDArray[Any]], trial: int, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Difference images [14, 3, 224, 224] of one trial and their normalised field changes [14, 1260]."""
    frames = decision_frames(source, table, trial)
    images = difference_images(frames[1:].flatten(0, 1), frames[:1].expand_as(frames[1:]).flatten(0, 1))
    fields = torch.from_numpy(table["fields"][trial, JITTER : JITTER + FRAMES_PER_DECISION].astype(np.float32))
    change = (fields[1:] - fields[:1]) * scale
    return images, change.flatten(0, 1).flatten(1)


# ---- heads ---------------------------------------------------------------------------------------------------------


def _fit_heads(config: RecipeConfig, role: str, network: AlexNetLstm, rows: Rows) -> int:
    """Train all layers after the frozen convolutions, on classes or on errors; returns the number of epochs."""
    for parameter in network.alexnet.features.parameters():
        parameter.requires_grad = False
    parts = (network.alexnet.classifier, network.lstm, network.output)
    parameters = [parameter for part in parts for parameter in part.parameters()]
    settings: StageConfig = getattr(config, role)
    train, held = rows.of("train"), rows.of("validation")
    labels = torch.from_numpy(class_of(rows.error)).to(network.device)
    errors = torch.from_numpy(rows.error).to(network.device)

    def batches(rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
        order = rng.permutation(train)
        for start in range(0, len(order), settings.batch):
            yield order[start : start + settings.batch]

    def loss(chosen: NDArray[np.int64]) -> Tensor:
        state = network.read(_batch(rows, chosen).to(network.device))
        if role == "direction":
            return functional.cross_entropy(network.logits(state), labels[chosen])
        return (network.error(state)[0] - errors[chosen]).square().mean()

    def validate() -> dict[str, float]:
        losses = [float(loss(part)) * len(part) for part in np.array_split(held, -(-len(held) // 32))]
        return {"score": sum(losses) / len(held)}

    stage = Stage(role, settings, parameters, batches, -(-len(train) // settings.batch), loss, validate)
    print(role, scalars := fit(network, stage, config.folder, config.seed))
    return int(scalars["epochs"])


def _batch(rows: Rows, chosen: NDArray[np.int64]) -> Tensor:
    return torch.from_numpy(rows.convolved[chosen].astype(np.float32))


# ---- figures -------------------------------------------------------------------------------------------------------


def finish(
    config: RecipeConfig, pair: AlexNetPair, rows: Rows, digest: str, epochs: dict[str, JsonValue]
) -> Checkpoint:
    """Constant spread and calibration from validation, figures of every split, checkpoint."""
    pair.eval()
    held = _predict(pair, rows, rows.of("validation"))
    spread = np.sqrt(np.square(held.error - held.truth).mean(0))
    pair.magnitude.log_sigma.copy_(torch.from_numpy(np.log(spread)))
    held = _predict(pair, rows, rows.of("validation"))
    scales = held.calibration()
    doubled = np.flatnonzero(rows.crop)
    scored = {split: chosen for split in SPLITS if len(chosen := np.setdiff1d(rows.of(split), doubled))}
    tables = by_split(
        {split: (_predict(pair, rows, chosen), rows.groups[chosen]) for split, chosen in scored.items()}, scales
    )
    checkpoint = Checkpoint(
        name=config.name,
        network=NETWORK,
        weights={name: value.detach().clone() for name, value in pair.state_dict().items()},
        scales=scales,
        joint_scales=scales,
        figures=tables,
        training_data_sha256=digest,
        git_commit=commit(),
        run=config.settings() | {"epochs_trained": epochs},
        sensor=rows.sensor,
    )
    checkpoint.save(config.folder / "checkpoint.pt")
    return checkpoint


def _predict(pair: AlexNetPair, rows: Rows, chosen: NDArray[np.int64]) -> Predictions:
    parts = []
    with torch.inference_mode():
        for part in np.array_split(chosen, -(-len(chosen) // 32)):
            convolved = _batch(rows, part)
            direction = pair.direction.logits(pair.direction.read(convolved))
            parts.append((direction, *pair.magnitude.error(pair.magnitude.read(convolved))))
    logits, error, log_sigma = (torch.cat(column).double().numpy() for column in zip(*parts, strict=True))
    return Predictions(logits, error, log_sigma, rows.error[chosen].astype(np.float64), rows.objects[chosen])
