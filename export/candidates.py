"""Networks that could decide: a folder of released step models, opened together and asked after 2, 4 and 8 frames."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from export.agreement import GAIN, density_mean, paper_rule
from export.measure import Timing, example_inputs, time_calls
from export.verify import Arrays, Model, open_model, told
from service.contract import ContractError, ModelCard
from service.perception.markers.sequence import track_pairs
from training.dataset import SPLITS, open_source
from training.labels import class_of

FRAME_COUNTS = (2, 4, 8)
PAIR = ("direction.step.onnx", "magnitude.step.onnx")
JOINT = ("joint.step.onnx",)
SHARED = ("pair.step.onnx",)
DYNAMIC = "int8-dynamic"
"""Folder of twins whose fully connected and recurrent layers of middling size are multiplied in int8, too."""
KINDS = {"pair": PAIR, "joint": JOINT, "shared": SHARED}
"""What a folder may hold that decides: two networks, a joint density, or two networks in one graph."""


@dataclass(frozen=True)
class Decision:
    """A recorded collision: ``frames`` uint8 [T, 2, H, W, 3] from the onset, the gap and the true error (mm, deg)."""

    frames: NDArray[np.uint8]
    gap_width_mm: float
    grasp_height_mm: float
    truth: NDArray[np.float32]
    name: str

    @cached_property
    def markers(self) -> NDArray[np.float32]:
        """Markers tracked in the frames: float32 [T, 2, rows, columns, 3]."""
        return track_pairs(self.frames)

    def seen_by(self, card: ModelCard) -> NDArray[Any]:
        """The decision as a card's graph reads it."""
        return self.markers if card.markers else self.frames


@dataclass(frozen=True)
class Answer:
    """What a candidate says of a decision: class index, error [2] and the command [2] that follows, in (mm, deg)."""

    chosen: int
    error: NDArray[np.float64]
    command: NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """The step models of one folder that decide together; ``kind`` is a key of KINDS."""

    name: str
    kind: str
    folder: Path
    models: tuple[Model, ...]

    @property
    def precision(self) -> str:
        """How its weights are stored."""
        stored = self.models[0].card.quantisation
        dynamic = " dynamic" if self.folder.name == DYNAMIC else ""
        return "fp32" if stored == "none" else stored + dynamic

    @property
    def origin(self) -> tuple[str, ...]:
        """What it shares with its twins of other precision: network, kind and the training it comes from."""
        card = self.models[0].card
        return self.name, self.kind, card.training_data_sha256, card.git_commit

    @cached_property
    def sha256(self) -> str:
        """Hash of all its files: an accuracy belongs to these bits and no others."""
        return hashlib.sha256(b"".join(model.file.read_bytes() for model in self.models)).hexdigest()

    def mean_trials(self) -> tuple[float, float, float] | None:
        """Mean trials and interval of a closed-loop run, if ``evaluation.json`` beside the models holds one."""
        path = self.folder / "evaluation.json"
        if not path.is_file():
            return None
        try:
            mean, (low, high) = (json.loads(path.read_text())[key] for key in ("mean_trials", "interval"))
            found = float(mean), float(low), float(high)
        except (ValueError, KeyError, TypeError) as error:
            raise ContractError(f"{path} needs mean_trials and interval [low, high]: {error!r}") from error
        if not (np.isfinite(found).all() and found[1] <= found[0] <= found[2]):
            raise ContractError(f"{path}: mean_trials {found[0]} lies outside its interval {found[1:]}")
        return found

    def answers(self, asked: Sequence[Decision], counts: tuple[int, ...] = FRAME_COUNTS) -> list[dict[int, Answer]]:
        """Of each decision, class, error and command after each number of frames, by really stopping there.

        Decisions are asked together: large weights are then read once for all of them.
        """
        outputs: dict[int, Arrays] = {count: {} for count in counts}
        for model in self.models:
            for seen, stepped in enumerate(_steps(model, asked), 1):
                if seen in counts:
                    outputs[seen] |= stepped
        card = self.models[0].card
        return [
            {
                seen: answer(card, {name: value[row : row + 1] for name, value in said.items()})
                for seen, said in outputs.items()
            }
            for row in range(len(asked))
        ]

    def time_step(self, seconds: float) -> Timing:
        """One step of all its models, one after the other, on one thread: what remains after the last frame."""
        inputs = [example_inputs(model) for model in self.models]
        return time_calls(lambda: [m(fed) for m, fed in zip(self.models, inputs, strict=True)], seconds=seconds)


def find_candidates(folders: list[Path]) -> list[Candidate]:
    """Every set of networks that decides together in the folders; ContractError on a folder that holds none."""
    found = []
    for folder in folders:
        kinds = {kind: names for kind, names in KINDS.items() if all((folder / name).is_file() for name in names)}
        if not kinds:
            raise ContractError(f"{folder} holds none of {', '.join(' and '.join(names) for names in KINDS.values())}")
        for kind, names in kinds.items():
            models = tuple(open_model(folder / name) for name in names)
            wrong = models[0].card.disagreements(models[-1].card)
            if wrong:
                raise ContractError(f"{folder}: {wrong[0]}")
            name = models[0].card.name.removesuffix(f"-{models[0].card.role}")
            found.append(Candidate(name, kind, folder, models))
    return found


def most_likely_class(card: ModelCard, outputs: Arrays) -> int:
    """Index of the class that a network's outputs hold for most likely; of an estimate alone, the class it lies in."""
    if "logits" in outputs:
        return int(outputs["logits"][0].argmax())
    if "error" in outputs:
        return int(class_of(outputs["error"])[0])
    density = outputs["log_density"][0].astype(np.float64)
    weight = np.exp(density - density.max())
    x_mm, theta_deg = np.meshgrid(card.grid_x_mm, card.grid_theta_deg, indexing="ij")
    cells = class_of(np.stack([x_mm, theta_deg], -1).reshape(-1, 2).astype(np.float32))
    return int(np.bincount(cells, weight.ravel(), len(card.classes)).argmax())


def answer(card: ModelCard, outputs: Arrays) -> Answer:
    """Class, estimate and command of all outputs of a candidate; a joint density's command needs no class."""
    error = estimate(card, outputs)
    ruled = paper_rule(card, outputs["logits"], outputs["error"])[0] if "logits" in outputs else -GAIN * error
    return Answer(most_likely_class(card, outputs), error, ruled)


def estimate(card: ModelCard, outputs: Arrays) -> NDArray[np.float64]:
    """Estimated error [2] in (mm, deg); a joint density's is its mean."""
    if "error" in outputs:
        return np.asarray(outputs["error"][0], np.float64)
    mean: NDArray[np.float64] = density_mean(card, outputs["log_density"])[0]
    return mean


def decided_class(model: Model, decision: Decision) -> int:
    """The class one network of either form decides for after all frames."""
    if model.card.form == "step":
        *_, outputs = _steps(model, [decision])
    else:
        outputs = model({"frames": decision.seen_by(model.card)[None]} | _told(model, [decision]))
    return most_likely_class(model.card, outputs)


def read_split(path: str, split: str, count: int) -> Iterator[Decision]:
    """``count`` collisions spread over a split of a dataset, drawn one at a time as they are asked for.

    Raises ContractError at once on an unknown split or a ``count`` below 1, when drawing if the split has no collision.
    """
    if split not in SPLITS:
        raise ContractError(f"no split {split!r}, expected one of {', '.join(SPLITS)}")
    if count < 1:
        raise ContractError(f"asked for {count} decisions, expected at least 1")
    return _drawn(path, split, count)


def _drawn(path: str, split: str, count: int) -> Iterator[Decision]:
    source = open_source(path)
    inside = [index for index in range(len(source)) if _collided(source.trial(index), split)]
    if not inside:
        raise ContractError(f"the dataset {path} has no collision in its split {split}")
    for place in np.linspace(0, len(inside) - 1, min(count, len(inside))).astype(int):
        trial = source.trial(inside[place])
        frames = source.frames(inside[place], int(trial.onset_frame), max(FRAME_COUNTS))
        truth = np.array([trial.x_mm, trial.theta_deg], np.float32)
        yield Decision(frames, float(trial.gap_width_mm), float(trial.grasp_height_mm), truth, str(trial.object_name))


def _collided(trial: object, split: str) -> bool:
    return getattr(trial, "split", "") == split and getattr(trial, "outcome", "") == "blocked"


def _told(model: Model, asked: Sequence[Decision]) -> Arrays:
    rows = [told(model.card, 1, one.gap_width_mm, one.grasp_height_mm) for one in asked]
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}


def _steps(model: Model, asked: Sequence[Decision]) -> Iterator[Arrays]:
    state = np.zeros((len(asked), model.card.state_size), np.float32)
    said = _told(model, asked)
    frames = np.stack([one.seen_by(model.card) for one in asked])
    for step in range(frames.shape[1]):
        fed: Arrays = {"frame": frames[:, step], "reference": frames[:, 0], "state": state}
        outputs = model(fed | said)
        state = outputs["next_state"]
        yield outputs
