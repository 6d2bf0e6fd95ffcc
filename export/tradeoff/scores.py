"""What networks decided on recorded collisions, kept between runs: running a large one again takes minutes."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from rich.progress import track

from export.onnx.decisions import FRAME_COUNTS, Answer, Decision
from export.tradeoff.agreement import Agreement
from export.tradeoff.candidates import Candidate
from service.contract import ContractError
from training.data.labels import class_of

TOGETHER = 8


@dataclass
class Score:
    """A candidate after one number of frames: right directions, errors of the estimates, commands."""

    hits: list[bool] = field(default_factory=list)
    off_mm: list[float] = field(default_factory=list)
    off_deg: list[float] = field(default_factory=list)
    chosen: list[int] = field(default_factory=list)
    commands: list[list[float]] = field(default_factory=list)

    def add(self, answer: Answer, decision: Decision, label: int) -> None:
        """Count one decision."""
        off = np.abs(answer.error - decision.truth)
        self.hits.append(answer.chosen == label)
        self.off_mm.append(float(off[0]))
        self.off_deg.append(float(off[1]))
        self.chosen.append(answer.chosen)
        self.commands.append([float(number) for number in answer.command])

    def agreement(self, other: "Score") -> Agreement:
        """How another candidate's commands compare with this one's, on the same decisions."""
        classes = np.array(self.chosen), np.array(other.chosen)
        return Agreement.of(classes, (np.array(self.commands), np.array(other.commands)))


Scores = dict[str, dict[int, Score]]


def score(candidates: list[Candidate], decisions: Iterable[Decision], kept: Path | None = None) -> Scores:
    """Scores of each candidate (by hash) after each number of frames.

    ``kept`` names a file of earlier answers to the same decisions; it is read, and written again with the new ones.
    Raises ContractError if there is no decision, or if the file holds anything else.
    """
    known = _read(kept)
    missing = [candidate for candidate in candidates if candidate.sha256 not in known]
    fresh: Scores = {c.sha256: {frames: Score() for frames in FRAME_COUNTS} for c in missing}
    for batch in _together(track(decisions, description="deciding", transient=True)) if missing else ():
        labels = [int(label) for label in class_of(np.stack([decision.truth for decision in batch]))]
        for candidate in missing:
            for decision, label, answers in zip(batch, labels, candidate.answers(batch), strict=True):
                for frames, answer in answers.items():
                    fresh[candidate.sha256][frames].add(answer, decision, label)
    scores = {c.sha256: (known | fresh)[c.sha256] for c in candidates}
    if not all(row.hits for by_frames in scores.values() for row in by_frames.values()):
        raise ContractError("there is no decision to score the networks on")
    if kept is not None and fresh:
        rows = {sha: {str(count): asdict(row) for count, row in by.items()} for sha, by in (known | fresh).items()}
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(rows))
    return scores


def _together(decisions: Iterable[Decision]) -> Iterator[list[Decision]]:
    iterator = iter(decisions)
    while batch := list(islice(iterator, TOGETHER)):
        yield batch


def _read(kept: Path | None) -> Scores:
    if kept is None or not kept.is_file():
        return {}
    try:
        rows = json.loads(kept.read_text())
        return {sha: {int(count): Score(**row) for count, row in by.items()} for sha, by in rows.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ContractError(f"{kept} does not hold earlier answers ({error}); remove it") from error
