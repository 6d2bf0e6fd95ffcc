"""The network that reads depth: the gel's motion on a lattice in mm, step by step, and the cell's numbers.

Its inputs are the motion, the motion over its own size, which shows the object's direction after little motion, and the
motion over the grasp's shear reach if known, through a layer of fixed random weights (docs/decisions/0075). It decides
after every step, and is trained to.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from service.contract import Sensor
from service.contract.model_card import CONDITIONS, Lattice, Role
from training.networks.affine import AffineFit
from training.networks.decider import Decider
from training.networks.settings import NetworkConfig
from training.networks.strangeness import Strangeness

LATTICE = Lattice(rows=13, columns=13, pitch_mm=1.5)
STEP_MM = 0.15
STEPS = 11
"""Steps in training; the card states how many of them a decision takes."""
FEWEST_STEPS, DECISION_STEPS = 4, 8
"""Steps of a press after which the service decides, as its `FEWEST_N`, unless slip ends it earlier."""
USUAL = (60.0, 60.0, 25.0, 0.8, 10.0, 0.2)
"""A middle value of each condition: the network reads the logarithm of the stated value over it."""
KNOWN_FEATURES = 2 * len(CONDITIONS)
SHARE_FEATURES = 64
VISIBLE = 0.5
LEAST = 1e-3
SHARES = slice(12, 24)
"""The affine fit's numbers for the motion of the patch that moves with the object."""


class PressingNetwork(Decider):
    """Decider that reads steps float32 [B, 2, rows, columns, 3]: (du_mm, dv_mm, 1 if visible)."""

    reads_steps = True
    roles: tuple[Role, ...] = ("pair", "joint")

    def __init__(self, settings: NetworkConfig, classes: int, sensor: Sensor) -> None:
        super().__init__(settings, classes, sensor)
        self.shares = nn.Linear(SHARES.stop - SHARES.start, SHARE_FEATURES).requires_grad_(False)
        self.strange = Strangeness()

    def grid(self, sensor: Sensor) -> tuple[int, int]:  # noqa: ARG002 any sensor is read on the same lattice
        """Rows and columns that the trunk reads."""
        return LATTICE.rows, LATTICE.columns

    channels = 5
    condition_features = KNOWN_FEATURES + SHARE_FEATURES

    def features(self, frame: Tensor, reference: Tensor) -> Tensor:
        """Features of a step, which is already a change, against a reference of no change."""
        visible = (torch.minimum(frame[..., 2:], reference[..., 2:]) > VISIBLE).to(frame.dtype)
        moved = (frame[..., :2] - reference[..., :2]) * self.field_scale[:2] * visible
        return self.encode(torch.cat([moved, visible], -1).movedim(-1, -3))

    def encode(self, fields: Tensor) -> Tensor:
        """Normalised steps [N, 2, 3, rows, columns] -> features, with the patch's motion and strangeness at the end."""
        moved, visible = fields[:, :, :2], fields[:, :, 2:]
        size = (moved.square().sum(2, keepdim=True).mean((3, 4), keepdim=True)).mean(1, keepdim=True).sqrt()
        maps = torch.cat([moved, moved / (size + LEAST), visible], 2)
        affine = self.trunk.affine
        assert isinstance(affine, AffineFit)
        raw = affine.raw(fields)
        read = torch.cat([self.trunk.read_maps(maps), affine.read_raw(raw)], 1)
        return torch.cat([read, raw[:, SHARES], self.strange(raw / affine.spread, fields)], 1)

    def advance(self, features: Tensor, geometry: Tensor, state: Tensor) -> Tensor:
        """One step; ``geometry`` [B, 6] as `CONDITIONS`, 0 where unknown."""
        count = SHARES.stop - SHARES.start + 1
        known = (geometry > 0).to(geometry.dtype)
        usual = torch.tensor(USUAL, dtype=geometry.dtype, device=geometry.device)
        log_ratios = known * torch.log(geometry.clamp_min(LEAST) / usual)
        reach = geometry[:, 3:4].clamp_min(0.02) * self.field_scale[:1]
        shares = torch.tanh(features[:, -count:-1] / reach) * known[:, 3:4]
        conditions = torch.cat([known, log_ratios, functional.relu(self.shares(shares))], 1)
        following: Tensor = self.trunk.cell(torch.cat([features[:, :-count], conditions], 1), state)
        return following

    def strangeness(self, features: Tensor) -> Tensor:
        """Strangeness [B, 1] of a step."""
        return features[:, -1:]

    def normalised(self, fields: Tensor) -> Tensor:
        """Motion over its spread, and visibility."""
        return torch.cat([fields[..., :2, :, :] * self.field_scale[:2, None, None], fields[..., 2:, :, :]], -3)

    def disturbed(self, fields: Tensor, front_error: Tensor) -> Tensor:  # noqa: ARG002 views carry their error
        """Unchanged: each view already contains a tracker's error."""
        return fields

    def read_steps(self, fields: Tensor, geometry: Tensor) -> Tensor:
        """States [B, T, S] after each step of normalised fields [B, T, 2, 3, rows, columns]."""
        count, steps = fields.shape[:2]
        features = self.encode(fields.flatten(0, 1)).reshape(count, steps, -1)
        state, states = torch.zeros(count, self.state_size, device=fields.device), []
        for step in range(steps):
            state = self.advance(features[:, step], geometry, state)
            states.append(state)
        return torch.stack(states, 1)
