"""Share of equal robot commands between two builds of a network."""

from collections.abc import Sequence

import numpy as np

from export.onnx.decisions import Decision
from export.onnx.model import Arrays, Model, geometry_inputs, steps
from service.decision.controllers import axis_command

SAME = (0.1, 0.1)  # mm, deg


def same_commands(source: Sequence[Model], build: Sequence[Model], decisions: Sequence[Decision]) -> int:
    """Number of decisions for which the step models of a source, deciding together, and their build agree."""
    ours, theirs = ([_command(models, decision) for decision in decisions] for models in (source, build))
    return int((np.abs(np.array(ours) - np.array(theirs)) <= SAME).all(1).sum())


def _command(models: Sequence[Model], decision: Decision) -> list[float]:
    """The service's command, mm and deg, of one decision alone: dynamic int8 takes its scales from the whole batch."""
    outputs: Arrays = {}
    for model in models:
        geometry = geometry_inputs(model.card, 1, decision.gap_width_mm, decision.grasp_height_mm)
        frames = decision.input_of(model.card)[None]
        *_, last = steps(model, frames, frames.shape[1], geometry)
        outputs |= last
    likeliest = models[0].card.classes[int(outputs["logits"][0].argmax())]
    signs = (likeliest.sign_x, likeliest.sign_theta)
    return [
        axis_command(sign, float(error), first=True) for sign, error in zip(signs, outputs["error"][0], strict=True)
    ]
