"""Networks that could decide: a folder of released step models, opened together and stopped after 2, 4 and 8 frames."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from export.onnx.decisions import FRAME_COUNTS, KINDS, Answer, Decision, answer, steps
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
        """How its weights are stored: fp32, fp16, or int8 with its mode, which is the name of the folder."""
        stored = self.models[0].card.quantisation
        return {"none": "fp32", "int8": self.folder.name.replace("-", " ")}.get(stored, stored)

    @property
    def origin(self) -> tuple[str, ...]:
        """What it shares with its builds of other precision: network, kind and the training it comes from."""
        card = self.models[0].card
        return self.name, self.kind, card.training_data_sha256, card.git_commit

    @cached_property
    def sha256(self) -> str:
        """Hash of all its files: an accuracy belongs to these bits and no others."""
        return hashlib.sha256(b"".join(model.file.read_bytes() for model in self.models)).hexdigest()

    def answers(self, decisions: Sequence[Decision]) -> list[dict[int, Answer]]:
        """Of each decision, class, error and command after 2, 4 and 8 frames, by really stopping there.

        Decisions are made together, so that large weights are read once for all of them; dynamic int8 makes them one
        by one, because it takes its scales from the whole batch.
        """
        if self.precision == "int8 dynamic" and len(decisions) > 1:
            return [self.answers([decision])[0] for decision in decisions]
        outputs: dict[int, Arrays] = {count: {} for count in FRAME_COUNTS}
        for model in self.models:
            for count, stepped in enumerate(steps(model, decisions), 1):
                if count in FRAME_COUNTS:
                    outputs[count] |= stepped
        card = self.models[0].card
        return [
            {
                count: answer(card, {name: value[row : row + 1] for name, value in values.items()})
                for count, values in outputs.items()
            }
            for row in range(len(decisions))
        ]


def find_candidates(folders: list[Path]) -> list[Candidate]:
    """Every set of networks that decides together in the folders; ContractError on a folder that holds none."""
    candidates = []
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
            candidates.append(Candidate(name, kind, folder, models))
    return candidates
