"""The marker network: marker displacements, already tracked for slip -> decision. No picture is read twice.

The tracker locates a marker to a twentieth of a pixel, ten times finer than a network can from pooled pictures. It does
not measure the gel's shading, and so not the pressure.
"""

import torch
from torch import Tensor

from service.contract import Sensor
from training.networks.decider import Decider
from training.networks.settings import NetworkConfig

TRACKING_PX = 0.08
"""Largest tracking error in training, RMS per axis: it is 0.04 px at the scenes' camera noise, 0.08 at three times."""
LOST_SHARE = 0.03
MISLED_SHARE = 0.01
"""Share of markers located at their neighbour or half way there: one in a hundred where motion varies steeply."""
VISIBLE = 0.5


class MarkerNetwork(Decider):
    """Marker fields float32 [B, 2, rows, columns, 3]: (du_px, dv_px, 1 if visible)."""

    reads_markers = True

    def __init__(self, settings: NetworkConfig, classes: int, sensor: Sensor) -> None:
        super().__init__(settings, classes, sensor)
        self.mm_per_px = sensor.mm_per_px  # the calibration brings every camera to this scale

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Fields of two instants -> features of the motion between them."""
        return self.trunk.encode(self._change(frame, reference))

    def _change(self, frame: Tensor, reference: Tensor) -> Tensor:
        """[N, 2, rows, columns, 3] twice -> normalised change [N, 2, 3, rows, columns].

        For each marker du, dv and whether it was visible both times.
        """
        visible = (torch.minimum(frame[..., 2:], reference[..., 2:]) > VISIBLE).to(frame.dtype)
        moved = (frame[..., :2] - reference[..., :2]) * self.mm_per_px * self.field_scale[:2] * visible
        return torch.cat([moved, visible], -1).movedim(-1, -3)

    def normalised(self, fields: Tensor) -> Tensor:
        """Motion over its spread; a channel with every marker visible replaces the pressure."""
        moved = fields[..., :2, :, :] * self.field_scale[:2, None, None]
        return torch.cat([moved, torch.ones_like(moved[..., :1, :, :])], -3)

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:  # noqa: ARG002 the tracker's error is known
        """Add the tracker's error on every frame but the first, and lost markers."""
        one = torch.empty(fields.shape[0], 1, 1, 1, 1, 1, device=fields.device)
        spread = torch.rand_like(one) * TRACKING_PX * self.mm_per_px * self.field_scale[:2, None, None]
        error = torch.randn_like(fields[..., :2, :, :])
        misled = torch.rand_like(fields[..., 2:, :, :]) < MISLED_SHARE * 2.0 * torch.rand_like(one)
        moved = fields[..., :2, :, :] * (1.0 + misled * torch.randn_like(fields[..., 2:, :, :]))
        moved = moved + spread * (error - error[:, :1])
        lost = LOST_SHARE * 2.0 * torch.rand_like(one)
        visible = (torch.rand_like(fields[..., 2:, :, :]) >= lost).to(fields.dtype)
        return torch.cat([moved * visible, visible], -3)

    def read_drawn(self, drawn: Tensor) -> Tensor:
        """Tracked [B, T, 2, rows, columns, 3] -> normalised fields [B, T, 2, 3, rows, columns] since the first."""
        return self._change(drawn, drawn[:, :1].expand_as(drawn))
