"""The compact image network: frames -> marker motion -> decision, under a million parameters.

``front`` reads each finger's pooled frame against its reference and returns the change of the marker field (du, dv,
pressure) on the 20 x 21 lattice: one output cell a marker cell, trained against the simulator's true fields.
``trunk`` reads the fields of both fingers, frame after frame, with a recurrent cell. The split lets the trunk train on
every trial without drawing a picture; both are tuned together on pictures at the end.
"""

from typing import Self

import torch
from torch import Tensor, nn

from training.config import NetworkConfig
from training.networks.density import MixtureDensity
from training.networks.forms import Role
from training.networks.preprocessing import BLOCK_MEAN, CHANNELS, IntegerPooling

FIELD_CHANNELS = 3
MARKER_ROWS, MARKER_COLS = 20, 21
GREY_SPAN = 32.0
ERROR_SCALE = 5.0
"""Heads speak in units of 5 mm and 5 deg, so that their outputs are of order one."""
LOG_SIGMA_SPAN = 3.0
TOLD = 3
"""Gap width, whether the grasp height is known, grasp height: what the cell says beside the pictures."""


def geometry_of(told: Tensor) -> Tensor:
    """Gap width and grasp height [B, 2] in mm, height 0 if unknown -> [B, TOLD] of order one."""
    gap, height = told[:, :1], told[:, 1:]
    known = (height > 0).to(height.dtype)
    return torch.cat([(gap - 56.0) / 10.0, known, known * (height - 60.0) / 30.0], 1)


class Front(nn.Module):
    """Pooled frame and reference [N, 2, 64, 65] (block sums) -> normalised field change [N, 3, 20, 21]."""

    def __init__(self, width: int) -> None:
        super().__init__()
        # Five blocks of 5 px every three blocks is one marker pitch (15 px): with the first block row left out, the
        # windows centre on the marker lattice of a rectified frame.
        self.cells = nn.Conv2d(2 * CHANNELS, width, 5, stride=3)
        self.context = nn.Conv2d(width, width, 3, padding=1)
        self.blend = nn.Conv2d(width, width, 3, padding=1)
        self.field = nn.Conv2d(width, FIELD_CHANNELS, 1)

    def forward(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Both inputs are block sums; the difference is taken after the exact pooling."""
        change = (frame - reference) * (BLOCK_MEAN / GREY_SPAN)
        level = reference * (BLOCK_MEAN / GREY_SPAN) - 128.0 / GREY_SPAN
        hidden = torch.relu(self.cells(torch.cat([change, level], 1)[:, :, 1:]))
        hidden = torch.relu(self.context(hidden))
        hidden = hidden + torch.relu(self.blend(hidden))
        field: Tensor = self.field(hidden)
        return field


class Trunk(nn.Module):
    """Normalised field changes of both fingers [B, 2, 3, 20, 21], what the cell told and state -> next state."""

    def __init__(self, settings: NetworkConfig) -> None:
        super().__init__()
        width = settings.trunk_width
        self.convolutions = nn.Sequential(
            nn.Conv2d(FIELD_CHANNELS, width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, 2 * width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.project = nn.Linear(2 * width * 5 * 6, settings.feature_size)
        self.dropout = nn.Dropout(settings.dropout)
        self.cell = nn.GRUCell(2 * settings.feature_size + TOLD, settings.state_size)

    def encode(self, fields: Tensor) -> Tensor:
        """Fields [N, 2, 3, 20, 21] -> features [N, 2 * feature_size], left finger first."""
        count = fields.shape[0]
        maps = fields.reshape(count * 2, FIELD_CHANNELS, MARKER_ROWS, MARKER_COLS)
        features = torch.relu(self.project(self.convolutions(maps)))
        kept: Tensor = self.dropout(features.reshape(count, -1))
        return kept

    def advance(self, features: Tensor, told: Tensor, state: Tensor) -> Tensor:
        """One step of the recurrent cell; ``told`` as in :func:`geometry_of`."""
        following: Tensor = self.cell(torch.cat([features, geometry_of(told)], 1), state)
        return following


class CompactNetwork(nn.Module):
    """Front, trunk and the two heads. ``field_scale`` [3] turns (mm, mm, N/mm2) into the normalised field."""

    field_scale: Tensor
    uses_geometry = True
    roles: tuple[Role, ...] = ("direction", "magnitude", "joint", "pair")

    def __init__(self, settings: NetworkConfig, classes: int) -> None:
        super().__init__()
        self.state_size = settings.state_size
        self.pooling = IntegerPooling()
        self.front = Front(settings.front_width)
        self.trunk = Trunk(settings)
        self.direction = nn.Linear(settings.state_size, classes)
        self.magnitude = nn.Linear(settings.state_size, 4)
        self.density = MixtureDensity(settings.state_size)
        self.register_buffer("field_scale", torch.ones(FIELD_CHANNELS))

    def of(self, _role: Role) -> Self:
        """The network of one role: this one, roles share all but the head."""
        return self

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Frames uint8 [B, 2, 320, 327, 3] -> features of the pair."""
        count, *image = frame.shape[0], *frame.shape[2:]
        pooled = self.pooling(frame.reshape(count * 2, *image))
        base = self.pooling(reference.reshape(count * 2, *image))
        return self.trunk.encode(self.front(pooled, base).reshape(count, 2, FIELD_CHANNELS, MARKER_ROWS, MARKER_COLS))

    def advance(self, features: Tensor, told: Tensor, state: Tensor) -> Tensor:
        """One recurrent step."""
        return self.trunk.advance(features, told, state)

    def logits(self, state: Tensor) -> Tensor:
        """Class logits [B, classes]."""
        logits: Tensor = self.direction(state)
        return logits

    def error(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Estimated position error [B, 2] in (mm, deg) and its log sigma [B, 2] (of mm, deg)."""
        out: Tensor = self.magnitude(state)
        log_sigma = LOG_SIGMA_SPAN * torch.tanh(out[:, 2:] / LOG_SIGMA_SPAN)
        return out[:, :2] * ERROR_SCALE, log_sigma + 1.0

    def log_density(self, state: Tensor) -> Tensor:
        """Log density of the position error on the joint grid [B, 41, 40]."""
        return self.density.on_grid(state)

    def read_fields(self, fields: Tensor, told: Tensor) -> Tensor:
        """Decision state after normalised field changes [B, T, 2, 3, 20, 21]."""
        count, steps = fields.shape[:2]
        features = self.trunk.encode(fields.flatten(0, 1)).reshape(count, steps, -1)
        state = torch.zeros(count, self.state_size, device=fields.device)
        for step in range(steps):
            state = self.advance(features[:, step], told, state)
        return state

    def read_pooled(self, pooled: Tensor) -> Tensor:
        """Pooled frames [B, T, 2, 2, 64, 65] -> normalised field changes [B, T, 2, 3, 20, 21] against the first."""
        count, steps = pooled.shape[:2]
        base = pooled[:, :1].expand_as(pooled)
        field: Tensor = self.front(pooled.flatten(0, 2), base.flatten(0, 2))
        return field.reshape(count, steps, 2, FIELD_CHANNELS, MARKER_ROWS, MARKER_COLS)
