"""Networks that could decide: a folder of released step models, opened together and asked after 2, 4 and 8 frames."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from export.bench.measure import Timing, example_inputs, time_calls
from export.onnx.decisions import DYNAMIC, FRAME_COUNTS, KINDS, Answer, Decision, answer, steps
from export.onnx.model import Arrays, Model, open_model
from service.contract import ContractError


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
            for seen, stepped in enumerate(steps(model, asked), 1):
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
