"""Share of equal robot commands between two builds of a network."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from export.onnx.decisions import Decision, command, steps
from export.onnx.model import Arrays, Model

SAME = (0.1, 0.1)  # mm, deg


def same_commands(source: Sequence[Model], build: Sequence[Model], decisions: Sequence[Decision]) -> int:
    """Number of decisions for which the step models of a source, deciding together, and their build agree."""
    ours, theirs = ([_command(models, decision) for decision in decisions] for models in (source, build))
    return int((np.abs(np.array(ours) - np.array(theirs)) <= SAME).all(1).sum())


def _command(models: Sequence[Model], decision: Decision) -> NDArray[np.float64]:
    """The command of one decision alone: dynamic int8 takes its scales from the whole batch."""
    outputs: Arrays = {}
    for model in models:
        *_, last = steps(model, [decision])
        outputs |= last
    return command(models[0].card, outputs)
