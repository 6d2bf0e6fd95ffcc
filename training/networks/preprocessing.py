"""The first layer of every image network: exact integer pooling of uint8 frames.

Pooling sums whole blocks, so a pooled frame is a small integer that float32 and uint16 both hold exactly: frames pooled
in the graph and frames pooled once into the training cache are the same numbers, bit for bit.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from service.contract import ContractError, Sensor

CHANNELS = 2
"""Green, and blue + red: the LEDs are green, so the two differ where the gel is pressed."""
BLOCKS_A_PITCH = 3
LARGEST_BLOCK_PX = 11
"""The sum of two colours over a larger block would not fit 16 bits."""


def block_px(sensor: Sensor) -> int:
    """Side of a block, a third of the marker pitch; ContractError where that is not a whole number of pixels."""
    side, rest = divmod(sensor.marker_pitch_px, BLOCKS_A_PITCH)
    if rest or side > LARGEST_BLOCK_PX:
        raise ContractError(
            f"sensor {sensor} has markers {sensor.marker_pitch_px:g} px apart; expected for pictures a multiple of"
            f" {BLOCKS_A_PITCH} px up to {BLOCKS_A_PITCH * LARGEST_BLOCK_PX}, or network.kind = 'markers'"
        )
    return int(side)


def pool_frames(frames: NDArray[np.uint8], sensor: Sensor) -> NDArray[np.uint16]:
    """Block sums of a sensor's rectified BGR frames: uint8 [..., H, W, 3] -> uint16 [..., 2, H / block, W / block]."""
    block, expected = block_px(sensor), sensor.rectified.shape
    if frames.dtype != np.uint8 or frames.shape[-3:] != expected:
        raise ValueError(f"frames are {frames.dtype}{list(frames.shape)}, expected uint8[..., {str(expected)[1:-1]}]")
    *lead, height, width, _ = frames.shape
    rows, columns = height // block, width // block
    cut = frames.reshape(-1, height, width, 3)[:, : rows * block, : columns * block]
    strips = cut.reshape(-1, rows, block, columns * block * 3).sum(2, dtype=np.uint16)
    blocks = strips.reshape(-1, rows, columns, block, 3).sum(3, dtype=np.uint16)
    pooled = np.stack([blocks[..., 1], blocks[..., 0] + blocks[..., 2]], axis=1)
    return pooled.reshape(*lead, CHANNELS, rows, columns)


def selector(width_px: int, block: int) -> NDArray[np.int8]:
    """Assignment of the bytes of a row of a BGR frame to sums: int8 [3 W, 2 (W // block)] of zeros and ones.

    The last columns, which fill no block, belong to no sum.
    """
    columns = width_px // block
    row = np.zeros((width_px, 3, CHANNELS, columns), np.int8)
    column = np.arange(columns * block)
    row[column, 1, 0, column // block] = 1
    for colour in (0, 2):
        row[column, colour, 1, column // block] = 1
    return row.reshape(width_px * 3, CHANNELS * columns)


@torch.library.custom_op("tactile_insertion::block_sums", mutates_args=())
def block_sums(frames: Tensor, block: int) -> Tensor:
    """As :func:`pool_frames`, inside the graph: uint8 [N, H, W, 3] -> float32 [N, 2, H / block, W / block].

    A separate operator, so that the exporter writes it as one integer product (:func:`selector`), in a quarter of the
    time of casting and adding.
    """
    rows, columns = frames.shape[1] // block, frames.shape[2] // block
    cut = frames[:, : rows * block, : columns * block].reshape(-1, rows, block, columns, block, 3)
    blocks = cut.float().sum((2, 4))
    return torch.stack([blocks[..., 1], blocks[..., 0] + blocks[..., 2]], 1)


@block_sums.register_fake
def _(frames: Tensor, block: int) -> Tensor:
    count, height, width, _ = frames.shape
    return frames.new_empty((count, CHANNELS, height // block, width // block), dtype=torch.float32)
