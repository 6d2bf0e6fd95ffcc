"""Motion of the held object as a whole, fitted to a marker field: the few small numbers behind a decision.

A rotation of the object about the vertical moves both fingers' markers by some hundredths of a millimetre, in a field
that moves by tenths. A network learns that difference of differences slowly; computed here, it is available from the
first epoch.
"""

import torch
from torch import Tensor, nn

NUMBERS = 41
QUIET = 0.02
"""Motion, in spreads of the fields, below which a field has no direction of motion."""
_LEAST = 1e-6


class AffineFit(nn.Module):
    """Normalised fields [N, 2, 3, rows, columns] (du, dv, weight) -> features [N, size] from the output of ``raw``."""

    place: Tensor
    spread: Tensor

    def __init__(self, size: int, rows: int, columns: int) -> None:
        super().__init__()
        v, u = torch.meshgrid(torch.linspace(-1, 1, rows), torch.linspace(-1, 1, columns), indexing="ij")
        self.register_buffer("place", torch.stack([u, v]), persistent=False)
        self.register_buffer("spread", torch.ones(NUMBERS))
        self.read = nn.Linear(NUMBERS, size)

    def forward(self, fields: Tensor) -> Tensor:
        return self.read_raw(self.raw(fields))

    def read_raw(self, raw: Tensor) -> Tensor:
        return torch.relu(self.read(raw / self.spread))

    def set_spread(self, fields: Tensor) -> None:
        """Scale each number to order one on fields like these."""
        self.spread.copy_(self.raw(fields).std(0).clamp_min(_LEAST))

    def raw(self, fields: Tensor) -> Tensor:
        """[N, NUMBERS]: the affine motion of the whole field, and of the patch that moves with the object.

        The patch is weighted by numbers that rise with a marker's motion up to the field's mean. Its motion is given
        twice: as it is, and divided by its own size, which shows the object's direction after little motion. Last come
        the size's logarithm and the centres of both patches.
        """
        visible = fields[:, :, 2:].clamp(0, 1)
        motion = fields[:, :, :2].square().sum(2, keepdim=True)
        rising = visible * motion / (motion + motion.mean((3, 4), keepdim=True) + _LEAST)
        whole, _ = _affine(fields[:, :, :2], _shares(visible), self.place)
        patch, centre = _affine(fields[:, :, :2], _shares(rising), self.place)
        size = (_shares(rising) * motion).sum((2, 3, 4)).mean(1, keepdim=True).sqrt() + QUIET
        return torch.cat([whole, patch, patch / size, size.log(), centre], 1)


def _shares(weight: Tensor) -> Tensor:
    return weight / (weight.sum((3, 4), keepdim=True) + _LEAST)


def _affine(moved: Tensor, share: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Half the difference and half the sum of both fingers' views, [N, 12], and the centres of their weights [N, 4].

    A finger's view is its mean (du, dv) and the gradients of du and dv along u and v. The fingers look at the object
    from opposite sides: its motion along x appears in the difference, its turn about z and its motion along z in the
    sum.
    """
    mean, centre = (share * moved).sum((3, 4)), (share * place).sum((3, 4))
    arm, rest = place - centre[..., None, None], moved - mean[..., None, None]
    along = [(share[:, :, 0] * arm[:, :, axis]) for axis in (0, 1)]
    lever = [(share[:, :, 0] * arm[:, :, axis].square()).sum((2, 3)) + QUIET**2 for axis in (0, 1)]
    grown = [(a[:, :, None] * rest).sum((3, 4)) / b[..., None] for a, b in zip(along, lever, strict=True)]
    left, right = torch.cat([mean, *grown], 2).unbind(1)
    return torch.cat([0.5 * (left - right), 0.5 * (left + right)], 1), centre.flatten(1)
