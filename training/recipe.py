"""The paper's own recipe, as the baseline that ours must beat: two independent AlexNet-LSTM networks.

Convolutions are frozen: ImageNet's if a state dict is given, otherwise pretrained here on simulated imprints (from a
difference frame to the gel's motion). Their features are computed once and kept; the fully connected layers and the
LSTM are then trained with Adam. Classes 7 and 8 are doubled with random crops, as in the paper.
"""

import json
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, ValidationError
from rich.progress import track
from torch import Tensor, nn
from torch.nn import functional

from service.contract.frames import Contract, ContractError
from training.checkpoint import Checkpoint, git_commit
from training.config import FRAMES_PER_DECISION, JITTER, NetworkConfig, StageConfig
from training.dataset import SPLITS, Source, data_sha256, load_table, open_source
from training.evaluate import Predictions, by_object, calibrate, cross_calibrated, rescaled
from training.fit import Log, Stage, fit
from training.labels import CLASSES, class_of
from training.networks.alexnet import FEATURES, AlexNetLstm, AlexNetPair, difference_images, load_imagenet

RARE = ("7", "8")
CROP_PX = 12
FIELD_SIZE = 3 * 20 * 21


class RecipeConfig(Contract):
    """One run of the recipe. Trials are those of each split, at most so many, chosen by the hash of their content."""

    name: str = Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")
    seed: int = 0
    threads: int = Field(default=1, ge=1)
    runs: str = "runs"
    data: str
    cache: str = "runs/cache"
    imagenet: str | None = None
    pretraining_trials: int = Field(default=500, ge=1)
    training_trials: int = Field(default=30_000, ge=1)
    validation_trials: int = Field(default=2000, ge=1)
    test_trials: int = Field(default=2000, ge=1)
    convolutions: StageConfig
    direction: StageConfig
    magnitude: StageConfig

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a TOML file; raise ContractError naming the file and the key that is wrong."""
        try:
            return cls.model_validate(tomllib.loads(path.read_text()))
        except OSError as error:
            raise ContractError(f"cannot read the recipe {path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, ValidationError) as error:
            raise ContractError(f"{path} is not a recipe: {str(error).splitlines()[0]}") from error

    @property
    def folder(self) -> Path:
        """Where this run writes."""
        return Path(self.runs) / self.name


@dataclass(frozen=True, slots=True)
class Rows:
    """Trials of the recipe with their cached features, float16 [N, 8, 2, 9216]; ``crop`` rows are doubled ones."""

    trial: NDArray[np.int64]
    crop: NDArray[np.bool_]
    split: NDArray[np.int64]
    error: NDArray[np.float32]
    objects: NDArray[np.str_]
    groups: NDArray[np.str_]
    convolved: NDArray[np.float16]

    def of(self, split: str) -> NDArray[np.int64]:
        """Rows of one split; doubled ones exist in training only."""
        return np.flatnonzero(self.split == SPLITS.index(split))


def train_recipe(config: RecipeConfig, source: Source | None = None) -> Checkpoint:
    """Run the recipe, or go on where it stopped; raises ContractError on data or weights that do not fit."""
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    source = open_source(config.data) if source is None else source
    folder = config.folder
    folder.mkdir(parents=True, exist_ok=True)
    table = load_table(source, Path(config.cache) / data_sha256(source)[:16], len(source))
    pair = AlexNetPair(len(CLASSES))
    log = Log(folder)
    try:
        if config.imagenet:
            for network in (pair.direction, pair.magnitude):
                load_imagenet(network, Path(config.imagenet))
        else:
            _pretrain(config, source, table, pair, log)
        rows = _rows(config, source, table, pair.direction)
        for role in pair.roles:
            network = pair.of(role)
            for parameter in network.alexnet.features.parameters():
                parameter.requires_grad = False
            print(role, fit(network, _head_stage(config, network, role, rows), folder, config.seed, log))
    finally:
        log.close()
    return _finish(config, pair, rows, data_sha256(source))


def _chosen(table: dict[str, NDArray[Any]], split: str, count: int) -> NDArray[np.int64]:
    order = np.argsort(table["key"])
    chosen: NDArray[np.int64] = order[table["split"][order] == SPLITS.index(split)][:count]
    return chosen


def _frames(source: Source, table: dict[str, NDArray[Any]], trial: int) -> Tensor:
    """The decision's frames of one trial, uint8 [8, 2, 320, 327, 3]."""
    start = int(table["start"][trial]) + JITTER
    return torch.from_numpy(source.frames(int(table["index"][trial]), start, FRAMES_PER_DECISION))


# ---- convolutions --------------------------------------------------------------------------------------------------


class _FieldReader(nn.Module):
    """Convolutions with a linear read-out of the marker field: what they are pretrained with."""

    def __init__(self, network: AlexNetLstm) -> None:
        super().__init__()
        self.features = network.alexnet.features
        self.read_out = nn.Linear(FEATURES, FIELD_SIZE)

    def forward(self, images: Tensor) -> Tensor:
        field: Tensor = self.read_out(self.features(images).flatten(1))
        return field


def _pretrain(
    config: RecipeConfig, source: Source, table: dict[str, NDArray[Any]], pair: AlexNetPair, log: Log
) -> None:
    """Difference frame -> change of the marker field, on training trials; both networks then start from the result."""
    reader = _FieldReader(pair.direction)
    chosen = _chosen(table, "train", config.pretraining_trials)
    held = _chosen(table, "validation", max(8, config.pretraining_trials // 10))
    fields = table["fields"][chosen].astype(np.float32)
    scale = torch.from_numpy(1.0 / np.maximum((fields - fields[:, :1]).std((0, 1, 2, 3, 4)), 1e-4))

    def examples(trials: NDArray[np.int64]) -> Iterator[tuple[Tensor, Tensor]]:
        for start in range(0, len(trials), 2):
            parts = [_field_examples(source, table, int(trial), scale) for trial in trials[start : start + 2]]
            yield torch.cat([part[0] for part in parts]), torch.cat([part[1] for part in parts])

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
    )
    print("convolutions", fit(reader, stage, config.folder, config.seed, log))
    pair.magnitude.alexnet.features.load_state_dict(pair.direction.alexnet.features.state_dict())


def _field_examples(source: Source, table: dict[str, NDArray[Any]], trial: int, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Difference images [14, 3, 224, 224] of one trial and their normalised field changes [14, 1260]."""
    frames = _frames(source, table, trial)
    images = difference_images(frames[1:].flatten(0, 1), frames[:1].expand_as(frames[1:]).flatten(0, 1))
    fields = torch.from_numpy(table["fields"][trial, JITTER : JITTER + FRAMES_PER_DECISION].astype(np.float32))
    change = (fields[1:] - fields[:1]) * scale
    return images, change.flatten(0, 1).flatten(1)


# ---- heads ---------------------------------------------------------------------------------------------------------


def _rows(config: RecipeConfig, source: Source, table: dict[str, NDArray[Any]], network: AlexNetLstm) -> Rows:
    """Choose trials, double the rare classes, and compute or read the frozen features."""
    counts = {"train": config.training_trials, "validation": config.validation_trials, "test": config.test_trials}
    trials = np.concatenate([_chosen(table, split, count) for split, count in counts.items()])
    names = np.array([entry.name for entry in CLASSES])[class_of(table["error"][trials])]
    rare = trials[np.isin(names, RARE) & (table["split"][trials] == SPLITS.index("train"))]
    every = np.concatenate([trials, rare])
    crop = np.arange(len(every)) >= len(trials)
    return Rows(
        every,
        crop,
        table["split"][every],
        table["error"][every],
        table["objects"][every],
        table["groups"][every],
        _convolved(config, source, table, network, every, crop),
    )


def _convolved(
    config: RecipeConfig,
    source: Source,
    table: dict[str, NDArray[Any]],
    network: AlexNetLstm,
    trials: NDArray[np.int64],
    crop: NDArray[np.bool_],
) -> NDArray[np.float16]:
    """Features [N, 8, 2, 9216], kept in the run's folder with the number of rows done, so that a kill costs one row."""
    path, counter = config.folder / "features.npy", config.folder / "features.done"
    shape = (len(trials), FRAMES_PER_DECISION, 2, FEATURES)
    kept = np.lib.format.open_memmap(path, "r+" if path.exists() else "w+", np.float16, shape)
    if kept.shape != shape:
        raise ContractError(f"{path} holds features of {kept.shape[0]} trials, expected {shape[0]}; remove it")
    done = int(counter.read_text()) if counter.exists() else 0
    rng = np.random.default_rng(config.seed)
    shifts = rng.integers(-CROP_PX, CROP_PX + 1, (len(trials), 2)) * crop[:, None]
    network.eval()
    with torch.inference_mode():
        for row in track(range(done, len(trials)), description="convolution features"):
            frames = _frames(source, table, int(trials[row]))
            reference = frames[:1].expand_as(frames)
            shift_px = (int(shifts[row, 0]), int(shifts[row, 1]))
            images = difference_images(frames.flatten(0, 1), reference.flatten(0, 1), shift_px)
            kept[row] = network.convolved(images).reshape(shape[1:]).half().numpy()
            counter.write_text(str(row + 1))
    kept.flush()
    return kept


def _head_stage(config: RecipeConfig, network: AlexNetLstm, role: str, rows: Rows) -> Stage:
    settings: StageConfig = getattr(config, role)
    train, held = rows.of("train"), rows.of("validation")
    labels = torch.from_numpy(class_of(rows.error))
    errors = torch.from_numpy(rows.error)

    def batches(rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
        order = rng.permutation(train)
        for start in range(0, len(order), settings.batch):
            yield order[start : start + settings.batch]

    def loss(chosen: NDArray[np.int64]) -> Tensor:
        state = network.read(_batch(rows, chosen))
        if role == "direction":
            return functional.cross_entropy(network.logits(state), labels[chosen])
        return (network.error(state)[0] - errors[chosen]).square().mean()

    def validate() -> dict[str, float]:
        losses = [float(loss(part)) * len(part) for part in np.array_split(held, -(-len(held) // 32))]
        return {"score": sum(losses) / len(held)}

    parameters = [*network.alexnet.classifier.parameters(), *network.lstm.parameters(), *network.output.parameters()]
    return Stage(role, settings, parameters, batches, -(-len(train) // settings.batch), loss, validate)


def _batch(rows: Rows, chosen: NDArray[np.int64]) -> Tensor:
    return torch.from_numpy(rows.convolved[chosen].astype(np.float32))


# ---- figures -------------------------------------------------------------------------------------------------------


def _finish(config: RecipeConfig, pair: AlexNetPair, rows: Rows, digest: str) -> Checkpoint:
    """Constant spread and calibration from validation, figures of every split, checkpoint."""
    pair.eval()
    held = _predict(pair, rows, rows.of("validation"))
    spread = np.sqrt(np.square(held.error - held.truth).mean(0))
    pair.magnitude.log_sigma.copy_(torch.from_numpy(np.log(spread)))
    held = _predict(pair, rows, rows.of("validation"))
    scales = calibrate(held)
    tables: dict[str, dict[str, float]] = {}
    for split in SPLITS:
        chosen = rows.of(split)
        chosen = chosen[~rows.crop[chosen]]
        if not len(chosen):
            continue
        said = _predict(pair, rows, chosen)
        fair = cross_calibrated(said, rows.groups[chosen]) if split == "validation" else rescaled(said, scales)
        tables |= {f"{split}/{name}": row for name, row in by_object(fair).items()}
    checkpoint = Checkpoint(
        name=config.name,
        network=NetworkConfig(kind="alexnet_lstm"),
        weights={name: value.detach().clone() for name, value in pair.state_dict().items()},
        scales=scales,
        joint_scales=scales,
        figures=tables,
        training_data_sha256=digest,
        git_commit=git_commit(),
    )
    checkpoint.save(config.folder / "checkpoint.pt")
    (config.folder / "figures.json").write_text(json.dumps(tables, indent=1))
    return checkpoint


def _predict(pair: AlexNetPair, rows: Rows, chosen: NDArray[np.int64]) -> Predictions:
    logits, errors, sigmas = [], [], []
    with torch.inference_mode():
        for part in np.array_split(chosen, -(-len(chosen) // 32)):
            convolved = _batch(rows, part)
            logits.append(pair.direction.logits(pair.direction.read(convolved)))
            estimate = pair.magnitude.error(pair.magnitude.read(convolved))
            errors.append(estimate[0])
            sigmas.append(estimate[1])
    said, error, log_sigma = (torch.cat(parts).double().numpy() for parts in (logits, errors, sigmas))
    return Predictions(said, error, log_sigma, rows.error[chosen].astype(np.float64), rows.objects[chosen])
