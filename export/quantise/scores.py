"""What networks decide on recorded collisions, after 2, 4 and 8 frames."""

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from typing import Any

import numpy as np
from rich.progress import track

from export.onnx.decisions import FRAME_COUNTS, Answer, Decision
from export.quantise.agreement import Agreement
from export.quantise.candidates import Candidate
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


def score(candidates: list[Candidate], decisions: Iterable[Decision]) -> Scores:
    """Scores of each candidate (by hash) after each number of frames; raises ContractError without any decision."""
    scores: Scores = {c.sha256: {frames: Score() for frames in FRAME_COUNTS} for c in candidates}
    for batch in _together(track(decisions, description="deciding", transient=True)):
        labels = [int(label) for label in class_of(np.stack([decision.truth for decision in batch]))]
        for candidate in candidates:
            for decision, label, answers in zip(batch, labels, candidate.answers(batch), strict=True):
                for frames, answer in answers.items():
                    scores[candidate.sha256][frames].add(answer, decision, label)
    if not all(row.hits for by_frames in scores.values() for row in by_frames.values()):
        raise ContractError("there is no decision to score the networks on")
    return scores


def _together(decisions: Iterable[Decision]) -> Iterator[list[Decision]]:
    """Batches: large weights are read once for all decisions of one."""
    iterator = iter(decisions)
    while batch := list(islice(iterator, TOGETHER)):
        yield batch


def agreements(candidates: list[Candidate], scores: Scores) -> list[dict[str, Any]]:
    """Each int8 and fp16 build against its fp32 source, by commands after all frames."""
    sources = {c.origin: c for c in candidates if c.precision == "fp32"}
    longest, rows = max(FRAME_COUNTS), []
    for build in candidates:
        source = sources.get(build.origin)
        if source is None or source is build:
            continue
        same = scores[source.sha256][longest].agreement(scores[build.sha256][longest])
        name = f"{build.name} {build.kind} {build.precision}"
        rows.append({"name": name, "summary": str(same), "same_command": same.same_command, **asdict(same)})
    return rows
