"""How the robot commands of two builds of a network on the same decisions compare."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from export.onnx.decisions import Answer, Decision, answer, steps
from export.onnx.model import Arrays, Model
from reporting.statistics import wilson

SAME_MM, SAME_DEG = 0.1, 0.1


@dataclass(frozen=True)
class Agreement:
    """How a build decides against its source on the same decisions."""

    decisions: int
    same_class: float
    same_commands: int
    sign_flips: int
    apart_p99_mm: float
    apart_p99_deg: float

    @classmethod
    def of(
        cls,
        classes: tuple[NDArray[np.int64], NDArray[np.int64]],
        commands: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> "Agreement":
        """Compare classes [N] and commands [N, 2] in (mm, deg) of the same decisions."""
        apart = np.abs(commands[0] - commands[1])
        same = int(((apart[:, 0] <= SAME_MM) & (apart[:, 1] <= SAME_DEG)).sum())
        flips = int((commands[0] * commands[1] < 0).any(1).sum())
        far_mm, far_deg = (float(value) for value in np.quantile(apart, 0.99, 0))
        return cls(len(apart), float((classes[0] == classes[1]).mean()), same, flips, far_mm, far_deg)

    def __str__(self) -> str:
        """One line, with the interval of the share."""
        return (
            f"{wilson(self.same_commands, self.decisions):.1%} of {self.decisions} commands within {SAME_MM} mm"
            f" and {SAME_DEG} deg (99 % within {self.apart_p99_mm:.2f} mm, {self.apart_p99_deg:.2f} deg),"
            f" {100 * self.same_class:.1f} % the same class, {self.sign_flips} sign flips"
        )


def compare(source: Sequence[Model], build: Sequence[Model], decisions: Sequence[Decision]) -> Agreement:
    """Step models that decide together against their builds of another precision."""
    ours, theirs = (_answers(models, decisions) for models in (source, build))
    classes = [np.array([one.chosen for one in answers]) for answers in (ours, theirs)]
    commands = [np.array([one.command for one in answers]) for answers in (ours, theirs)]
    return Agreement.of((classes[0], classes[1]), (commands[0], commands[1]))


def _answers(models: Sequence[Model], decisions: Sequence[Decision]) -> list[Answer]:
    """One decision after the other: dynamic int8 takes its scales from the whole batch."""
    answers = []
    for decision in decisions:
        outputs: Arrays = {}
        for model in models:
            *_, last = steps(model, [decision])
            outputs |= last
        answers.append(answer(models[0].card, outputs))
    return answers
