"""The compact image network: frames -> marker motion -> decision, under a million parameters.

``front`` reads each finger's pooled frame against its reference and returns the change of the marker field (du, dv,
pressure) on the marker lattice: one output cell per marker cell, trained against the simulator's true fields. The split
lets the trunk train on every trial without drawing a picture; both are tuned together on pictures at the end.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.contract import Sensor
from training.networks.decider import FIELD_CHANNELS, Decider
from training.networks.preprocessing import BLOCKS_A_PITCH, CHANNELS, block_px, block_sums
from training.networks.settings import NetworkConfig

GREY_SPAN = 32.0
WINDOW = 5


class Front(nn.Module):
    """Pooled frame and reference [N, 2, blocks, blocks] (block sums) -> normalised field change [N, 3, rows, columns].

    A window of five blocks every three, which are one pitch, centres on each marker of a rectified frame.
    """

    def __init__(self, width: int, sensor: Sensor) -> None:
        super().__init__()
        block = block_px(sensor)
        self.scale = 1.0 / (block * block) / GREY_SPAN
        self.pad: list[int] = []
        for first, count, size in (
            (sensor.first_marker_px[0], sensor.marker_columns, sensor.width_px // block),
            (sensor.first_marker_px[1], sensor.marker_rows, sensor.height_px // block),
        ):
            before = round((first + 0.5) / block - 0.5 * WINDOW)
            self.pad += [-before, before + BLOCKS_A_PITCH * (count - 1) + WINDOW - size]
        self.cells = nn.Conv2d(2 * CHANNELS, width, WINDOW, stride=BLOCKS_A_PITCH)
        self.context = nn.Conv2d(width, width, 3, padding=1)
        self.blend = nn.Conv2d(width, width, 3, padding=1)
        self.field = nn.Conv2d(width, FIELD_CHANNELS, 1)

    def forward(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Both inputs are block sums; the difference is taken after the exact pooling."""
        change = (frame - reference) * self.scale
        level = reference * self.scale - 128.0 / GREY_SPAN
        hidden = torch.relu(self.cells(functional.pad(torch.cat([change, level], 1), self.pad)))
        hidden = torch.relu(self.context(hidden))
        hidden = hidden + torch.relu(self.blend(hidden))
        field: Tensor = self.field(hidden)
        return field


class CompactNetwork(Decider):
    """Decider that reads pictures through the front."""

    front: Front

    def __init__(self, settings: NetworkConfig, classes: int, sensor: Sensor) -> None:
        super().__init__(settings, classes, sensor)
        self.front = Front(settings.front_width, sensor)
        self.block_px = block_px(sensor)

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Frames uint8 [B, 2, H, W, 3] -> features of the pair."""
        count, *image = frame.shape[0], *frame.shape[2:]
        pooled = block_sums(frame.reshape(count * 2, *image), self.block_px)
        base = block_sums(reference.reshape(count * 2, *image), self.block_px)
        fields = self.front(pooled, base)
        return self.trunk.encode(fields.reshape(count, 2, *fields.shape[1:]))

    def normalised(self, fields: Tensor) -> Tensor:
        """Motion and pressure, each over its spread."""
        return fields * self.field_scale[:, None, None]

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:
        """Add white and smooth error of the front's measured size."""
        white = torch.randn_like(fields)
        smooth = torch.randn(*fields.shape[:-2], 1, 1, device=fields.device)
        strength = torch.rand(fields.shape[0], 1, 1, 1, 1, 1, device=fields.device) * 1.5
        spread = front_error[:, :, None, None]
        return fields + strength * (white * spread[0] + smooth * spread[1])

    def read_drawn(self, drawn: Tensor) -> Tensor:
        """Pooled frames [B, T, 2, 2, h, w] -> normalised fields [B, T, 2, 3, rows, columns] against the first."""
        count, steps = drawn.shape[:2]
        base = drawn[:, :1].expand_as(drawn)
        field: Tensor = self.front(drawn.flatten(0, 2), base.flatten(0, 2))
        return field.reshape(count, steps, 2, *field.shape[1:])
