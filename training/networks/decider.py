"""Common part of our networks: from marker motion of both fingers, frame by frame, to a decision.

``Trunk`` reads the fields of both fingers with a recurrent cell; ``Decider`` adds the heads. The networks differ in how
they obtain the fields from the cameras; see :mod:`training.networks.compact` and :mod:`training.networks.markers`.
"""

from typing import Self

import torch
from torch import Tensor, nn

from service.contract import Sensor
from service.contract.model_card import Role
from training.networks.affine import AffineFit
from training.networks.density import MixtureDensity
from training.networks.settings import NetworkConfig

FIELD_CHANNELS = 3
ERROR_SCALE = 5.0
"""Heads output units of 5 mm and 5 deg, so that their outputs are of order one."""
AFFINE_FEATURES = 64
LOG_SIGMA_SPAN = 3.0
STATE_REACH = 1.001
"""A GRU's state is a mean of its last state and a tanh, so it exceeds +-1 only by rounding."""
GEOMETRY_FEATURES = 3
"""Gap width, whether the grasp height is known, grasp height: the cell's data besides the pictures."""


def geometry_features(geometry: Tensor) -> Tensor:
    """Gap width and grasp height [B, 2] in mm, height 0 if unknown -> [B, GEOMETRY_FEATURES] of order one."""
    gap, height = geometry[:, :1], geometry[:, 1:]
    known = (height > 0).to(height.dtype)
    return torch.cat([(gap - 56.0) / 10.0, known, known * (height - 60.0) / 30.0], 1)


class Trunk(nn.Module):
    """Normalised field changes of both fingers [B, 2, 3, rows, columns], gap and grasp, and state -> next state."""

    def __init__(self, settings: NetworkConfig, grid: tuple[int, int], channels: int, conditions: int) -> None:
        super().__init__()
        width = settings.trunk_width
        cells = -(-grid[0] // 4) * -(-grid[1] // 4)
        self.convolutions = nn.Sequential(
            nn.Conv2d(channels, width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, 2 * width, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
        )
        self.project = nn.Linear(2 * width * cells, settings.feature_size)
        self.dropout = nn.Dropout(settings.dropout)
        self.affine = AffineFit(AFFINE_FEATURES, *grid) if settings.affine_fit else None
        features = 2 * settings.feature_size + (AFFINE_FEATURES if settings.affine_fit else 0)
        self.cell = nn.GRUCell(features + conditions, settings.state_size)

    def encode(self, fields: Tensor) -> Tensor:
        """Fields [N, 2, 3, rows, columns] -> features [N, F]: of the left finger, the right one, and both together."""
        kept = self.read_maps(fields)
        return kept if self.affine is None else torch.cat([kept, self.affine(fields)], 1)

    def read_maps(self, maps: Tensor) -> Tensor:
        """Maps [N, 2, channels, rows, columns] -> features of the left finger and the right one."""
        count = maps.shape[0]
        features = torch.relu(self.project(self.convolutions(maps.reshape(count * 2, *maps.shape[2:]))))
        kept: Tensor = self.dropout(features.reshape(count, -1))
        return kept

    def advance(self, features: Tensor, geometry: Tensor, state: Tensor) -> Tensor:
        """One step of the recurrent cell; ``geometry`` as for :func:`geometry_features`."""
        following: Tensor = self.cell(torch.cat([features, geometry_features(geometry)], 1), state)
        return following


class Decider(nn.Module):
    """Trunk and heads. ``field_scale`` [3] scales a field's (mm, mm, third channel) to order one."""

    field_scale: Tensor
    state_reach = STATE_REACH
    uses_geometry = True
    reads_markers = False
    reads_steps = False
    channels = FIELD_CHANNELS
    condition_features = GEOMETRY_FEATURES
    roles: tuple[Role, ...] = ("direction", "magnitude", "joint", "pair")

    def __init__(self, settings: NetworkConfig, classes: int, sensor: Sensor) -> None:
        super().__init__()
        self.state_size = settings.state_size
        self.trunk = Trunk(settings, self.grid(sensor), self.channels, self.condition_features)
        self.direction = nn.Linear(settings.state_size, classes)
        self.magnitude = nn.Linear(settings.state_size, 4)
        self.density = MixtureDensity(settings.state_size)
        self.front: nn.Module | None = None
        """Front of a network that reads pictures; it is trained first, on true fields."""
        self.register_buffer("field_scale", torch.ones(FIELD_CHANNELS))

    @property
    def device(self) -> torch.device:
        """Where its weights are."""
        return self.field_scale.device

    def grid(self, sensor: Sensor) -> tuple[int, int]:
        return sensor.marker_rows, sensor.marker_columns

    def set_scales(self, fields: Tensor) -> None:
        """Scale field changes [N, T, 2, 3, rows, columns] like these to order one; u and v alike: turns stay turns."""
        spread = fields.std((0, 1, 2, 4, 5)).clamp_min(1e-4)
        spread[:2] = spread[:2].square().mean().sqrt()
        self.field_scale.copy_(1.0 / spread)
        if self.trunk.affine is not None:
            self.trunk.affine.set_spread(self.normalised(fields).flatten(0, 1))

    def normalised(self, fields: Tensor) -> Tensor:
        """True field changes [.., 3, rows, columns] in (mm, mm, N/mm2) as input of the trunk, without error."""
        raise NotImplementedError

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:
        """Normalised fields [B, T, 2, 3, rows, columns] with realistic errors; ``front_error`` [2, 3] as measured."""
        raise NotImplementedError

    def read_drawn(self, drawn: Tensor) -> Tensor:
        """Cached inputs from pictures [B, T, 2, ...] -> normalised field changes since the first frame."""
        raise NotImplementedError

    def of(self, _role: Role) -> Self:
        """The network of one role: this one; roles differ only in the head."""
        return self

    def advance(self, features: Tensor, geometry: Tensor, state: Tensor) -> Tensor:
        return self.trunk.advance(features, geometry, state)

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

    def read_steps(self, fields: Tensor, geometry: Tensor) -> Tensor:
        """States after each step of depth [B, T, S]; only for networks that read these."""
        raise NotImplementedError

    def read_fields(self, fields: Tensor, geometry: Tensor) -> Tensor:
        """Decision state after normalised field changes [B, T, 2, 3, rows, columns]."""
        count, steps = fields.shape[:2]
        features = self.trunk.encode(fields.flatten(0, 1)).reshape(count, steps, -1)
        state = torch.zeros(count, self.state_size, device=fields.device)
        for step in range(steps):
            state = self.advance(features[:, step], geometry, state)
        return state
