"""What a network sees of a pair of frames: the rectified pictures, or the marker fields that perception tracked."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.contract import ModelCard
from service.decision.evidence import Refusal
from service.perception.markers.field import marker_array
from service.perception.markers.sequence import track_pairs
from service.perception.observation import PairObservation


def network_pair(card: ModelCard, pair: PairObservation) -> NDArray[Any]:
    """A pair as the card's graph reads it, left finger first; raise Refusal if the grid found is not the card's."""
    if card.markers is None:
        return pair.pixels()
    try:
        return np.stack([marker_array(finger.field, card.markers) for finger in pair.fingers])
    except ValueError as error:
        raise Refusal("out_of_distribution", str(error)) from error


def network_frames(card: ModelCard, frames: NDArray[np.uint8]) -> NDArray[Any]:
    """Recorded rectified frames uint8 [n, 2, H, W, 3] as the card's graph reads them: [n, 2, *card.input_shape].

    Raises Refusal if the grid found is not the card's.
    """
    if card.markers is None:
        return frames
    try:
        return track_pairs(frames, card.markers, card.profile.fps)
    except ValueError as error:
        raise Refusal("out_of_distribution", str(error)) from error
