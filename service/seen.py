"""What a network sees of a pair of frames: the rectified pictures, or the marker fields that perception tracked."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import ModelCard
from service.decision import Refusal
from service.observation import PairObservation
from service.perception.field import marker_array
from service.perception.sequence import track_pairs


def seen_by(card: ModelCard, pair: PairObservation) -> NDArray[Any]:
    """A pair as the card's graph reads it, left finger first; raise Refusal if the grid found is not the card's."""
    if card.markers is None:
        return pair.pixels()
    fields = [marker_array(finger.field) for finger in pair.fingers]
    for field in fields:
        _check_grid(card, field.shape)
    return np.stack(fields)


def seen_in(card: ModelCard, frames: NDArray[np.uint8]) -> NDArray[Any]:
    """Recorded rectified frames uint8 [n, 2, H, W, 3] as the card's graph reads them: [n, 2, *card.input_shape].

    Raises Refusal if the grid found is not the card's.
    """
    if card.markers is None:
        return frames
    try:
        fields = track_pairs(frames)
    except ValueError as error:
        raise Refusal("out_of_distribution", str(error)) from error
    _check_grid(card, fields.shape[2:])
    return fields


def _check_grid(card: ModelCard, found: tuple[int, ...]) -> None:
    if found != card.input_shape:
        grids = " x ".join(str(n) for n in found[:2]), " x ".join(str(n) for n in card.input_shape[:2])
        raise Refusal("out_of_distribution", f"a grid of {grids[0]} markers was found, {card.name} reads {grids[1]}")
