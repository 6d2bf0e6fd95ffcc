"""The two forms in which every network is exported, from one set of weights.

``SequenceForm`` reads a whole decision at once, ``StepForm`` one frame pair at a time. Both do the same arithmetic, so
they agree to rounding. Inputs and outputs are those of :class:`service.contract.ModelCard`.
"""

from typing import Protocol

import torch
from torch import Tensor, nn

from service.contract.model_card import Role
from training.networks.settings import FRAMES_PER_DECISION


class Recurrent(Protocol):
    """The interface of an exportable network.

    ``frame`` and ``reference`` are uint8 [B, 2, H, W, 3], or marker fields float32 [B, 2, rows, columns, 3].
    """

    state_size: int
    state_reach: float | Tensor
    uses_geometry: bool
    reads_markers: bool

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Features of a frame pair against its reference."""

    def advance(self, features: Tensor, geometry: Tensor | None, state: Tensor) -> Tensor:
        """One recurrent step; ``geometry`` [B, 2] is gap width and grasp height in mm."""

    def strangeness(self, features: Tensor) -> Tensor:
        """How unlike training a step is, [B, 1]; only for networks that read steps of depth."""

    def logits(self, state: Tensor) -> Tensor:
        """Class logits of a state."""

    def error(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Position error and log sigma of a state."""

    def log_density(self, state: Tensor) -> Tensor:
        """Log density of the position error on a grid."""


class _Form(nn.Module):
    def __init__(self, network: Recurrent, role: Role) -> None:
        super().__init__()
        self.network = network
        self.role = role

    def decide(self, state: Tensor) -> tuple[Tensor, ...]:
        if self.role == "joint":
            return (self.network.log_density(state),)
        if self.role == "pair":
            return (self.network.logits(state), *self.network.error(state))
        return (self.network.logits(state),) if self.role == "direction" else self.network.error(state)


def within_reach(state: Tensor, reach: float | Tensor) -> Tensor:
    """A recurrent state [B, S] from outside, scaled back to the magnitudes that the cell can reach.

    A state within reach is unchanged, bit for bit (the factor is 1). NaN stays NaN and infinity becomes NaN: the
    service refuses both by name, whereas a clamp would turn them into a decision.
    """
    return state * torch.clamp(reach / state.abs(), max=1.0)


def _geometry(gap_width_mm: Tensor | None, grasp_height_mm: Tensor | None) -> Tensor | None:
    if gap_width_mm is None or grasp_height_mm is None:
        return None
    return torch.cat([gap_width_mm, grasp_height_mm], 1)


class StepForm(_Form):
    """(frame, reference, state, gap_width_mm, grasp_height_mm) -> (outputs..., next_state)."""

    def forward(
        self,
        frame: Tensor,
        reference: Tensor,
        state: Tensor,
        gap_width_mm: Tensor | None = None,
        grasp_height_mm: Tensor | None = None,
        conditions: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """One step; ``state`` [B, state_size], zeros at first. ``conditions`` [B, 6] come with steps of depth."""
        geometry = _geometry(gap_width_mm, grasp_height_mm) if conditions is None else conditions
        features = self.network.features(frame, reference)
        following = self.network.advance(features, geometry, within_reach(state, self.network.state_reach))
        strange = () if conditions is None else (self.network.strangeness(features),)
        return (*self.decide(following), *strange, following)


class SequenceForm(_Form):
    """(frames, gap_width_mm, grasp_height_mm) -> outputs; ``frames`` uint8 [B, 8, 2, H, W, 3], reference first."""

    def forward(
        self, frames: Tensor, gap_width_mm: Tensor | None = None, grasp_height_mm: Tensor | None = None
    ) -> tuple[Tensor, ...]:
        """A whole decision; features of all frames in one pass, so that large weights are read once."""
        count = frames.shape[0]
        reference, geometry = frames[:, :1].expand_as(frames), _geometry(gap_width_mm, grasp_height_mm)
        features = self.network.features(frames.flatten(0, 1), reference.flatten(0, 1))
        features = features.reshape(count, FRAMES_PER_DECISION, -1)
        state = torch.zeros(count, self.network.state_size)
        for step in range(FRAMES_PER_DECISION):
            state = self.network.advance(features[:, step], geometry, state)
        return self.decide(state)
