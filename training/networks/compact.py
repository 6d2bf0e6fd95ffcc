"""The compact image network: frames -> marker motion -> decision, under a million parameters.

``front`` reads each finger's pooled frame against its reference and returns the change of the marker field (du, dv,
pressure) on the 20 x 21 lattice: one output cell a marker cell, trained against the simulator's true fields. The split
lets the trunk train on every trial without drawing a picture; both are tuned together on pictures at the end.
"""

import torch
from torch import Tensor, nn

from training.networks.decider import FIELD_CHANNELS, MARKER_COLS, MARKER_ROWS, Decider
from training.networks.preprocessing import BLOCK_MEAN, CHANNELS, block_sums
from training.networks.settings import NetworkConfig

GREY_SPAN = 32.0


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


class CompactNetwork(Decider):
    """Pictures, by way of the front."""

    front: Front

    def __init__(self, settings: NetworkConfig, classes: int) -> None:
        super().__init__(settings, classes)
        self.front = Front(settings.front_width)

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Frames uint8 [B, 2, 320, 327, 3] -> features of the pair."""
        count, *image = frame.shape[0], *frame.shape[2:]
        pooled = block_sums(frame.reshape(count * 2, *image))
        base = block_sums(reference.reshape(count * 2, *image))
        return self.trunk.encode(self.front(pooled, base).reshape(count, 2, FIELD_CHANNELS, MARKER_ROWS, MARKER_COLS))

    def normalised(self, fields: Tensor) -> Tensor:
        """Motion and pressure, each over its spread."""
        return fields * self.field_scale[:, None, None]

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:
        """White and smooth error of the size that the front's has."""
        white = torch.randn_like(fields)
        smooth = torch.randn(*fields.shape[:-2], 1, 1)
        strength = torch.rand(fields.shape[0], 1, 1, 1, 1, 1) * 1.5
        spread = front_error[:, :, None, None]
        return fields + strength * (white * spread[0] + smooth * spread[1])

    def read_drawn(self, drawn: Tensor) -> Tensor:
        """Pooled frames [B, T, 2, 2, 64, 65] -> normalised field changes [B, T, 2, 3, 20, 21] against the first."""
        count, steps = drawn.shape[:2]
        base = drawn[:, :1].expand_as(drawn)
        field: Tensor = self.front(drawn.flatten(0, 2), base.flatten(0, 2))
        return field.reshape(count, steps, 2, FIELD_CHANNELS, MARKER_ROWS, MARKER_COLS)
