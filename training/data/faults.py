"""Faults of cameras and trackers, applied to the motion of both fingers: [N, 2, 2, rows, columns] (du, dv)."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor


def mirrored(one: Tensor) -> Tensor:
    """A finger's motion [N, 2, rows, columns] in a picture mirrored left to right."""
    return one.flip(-1) * torch.tensor([-1.0, 1.0])[:, None, None]


def quarter_turn(one: Tensor) -> Tensor:
    """A finger's motion [N, 2, rows, columns] in a picture turned by 90 deg; the grid is square."""
    turned = one.rot90(1, (-2, -1))
    return torch.stack([turned[:, 1], -turned[:, 0]], 1)


def half_turn(one: Tensor) -> Tensor:
    """A finger's motion [N, 2, rows, columns] in a picture upside down."""
    return -one.flip(-1).flip(-2)


def with_faults(moved: Tensor, rng: torch.Generator) -> Tensor:
    """Motion with one random fault each, of either finger's camera or tracker, or of the sign of both."""
    count, columns = len(moved), moved.shape[-1]
    rows, finger = torch.arange(count), torch.randint(0, 2, (count,), generator=rng)
    one, other, size = moved[rows, finger], moved[rows, 1 - finger], _size(moved)

    def drawn(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(count, 1, 1, 1, generator=rng)

    scale, angle_rad = drawn(1.6, 3.0), drawn(0.0, 2.0 * torch.pi)
    jump = size * drawn(1.5, 4.0) * torch.cat([angle_rad.cos(), angle_rad.sin()], 1)
    taken = torch.arange(columns) < drawn(0.2, 0.8) * columns
    pictures = [
        mirrored(one),
        half_turn(one),
        mirrored(half_turn(one)),
        quarter_turn(one),
        half_turn(quarter_turn(one)),
    ]
    motions = [-one, 0.0 * one, other, scale * one, one / scale, one + jump * taken]
    noise = one + size * drawn(0.3, 1.0) * torch.randn(one.shape, generator=rng)
    kinds = torch.stack([*pictures, *motions, noise])
    kind = torch.randint(0, len(kinds) + 1, (count,), generator=rng)
    faulty = moved.clone()
    faulty[rows, finger] = kinds[kind.clamp(max=len(kinds) - 1), rows]
    return torch.where((kind == len(kinds))[:, None, None, None, None], -moved, faulty)


def _size(moved: Tensor) -> Tensor:
    """Root mean square of each press, [N, 1, 1, 1]."""
    return moved.square().mean((1, 2, 3, 4)).sqrt()[:, None, None, None]


def _one(finger: int, change: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    def shifted(moved: Tensor) -> Tensor:
        changed = moved.clone()
        changed[:, finger] = change(moved[:, finger])
        return changed

    return shifted


def _noise(one: Tensor) -> Tensor:
    size = one.square().mean((1, 2, 3), keepdim=True).sqrt()
    return one + 0.5 * size * torch.randn(one.shape, generator=torch.Generator().manual_seed(0))


def _jump(one: Tensor) -> Tensor:
    """Half of the markers are taken for their neighbours: a motion of a whole pitch that nothing made."""
    jumped = one.clone()
    jumped[..., : one.shape[-1] // 2] += one.square().mean().sqrt() * 3.0
    return jumped


SHIFTS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "left camera mirrored": _one(0, mirrored),
    "right camera mirrored": _one(1, mirrored),
    "left camera upside down": _one(0, half_turn),
    "left camera turned by 90 deg": _one(0, quarter_turn),
    "left camera frozen": _one(0, torch.zeros_like),
    "left camera shown twice": lambda moved: moved[:, :1].expand_as(moved),
    "motion with the wrong sign": lambda moved: -moved,
    "left camera at twice the scale": _one(0, lambda one: 2.0 * one),
    "markers taken for their neighbours": _one(0, _jump),
    "fields of noise": _one(0, _noise),
}
"""Faults by which strangeness is judged."""
