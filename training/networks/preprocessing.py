"""The first layer of every image network: exact integer pooling of uint8 frames.

Pooling sums whole blocks, so a pooled frame is a small integer that float32 and uint16 both hold exactly: frames pooled
in the graph and frames pooled once into the training cache are the same numbers, bit for bit.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

HEIGHT_PX, WIDTH_PX = 320, 327
BLOCK_PX = 5
ROWS, COLS = HEIGHT_PX // BLOCK_PX, WIDTH_PX // BLOCK_PX
CHANNELS = 2
"""Green, and blue + red: the LEDs are green, so the two differ where the gel is pressed."""
BLOCK_MEAN = 1.0 / (BLOCK_PX * BLOCK_PX)


def pool_frames(frames: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Block sums of BGR frames: uint8 [..., 320, 327, 3] -> uint16 [..., 2, 64, 65]."""
    lead = frames.shape[:-3]
    if frames.dtype != np.uint8 or frames.shape[-3:] != (HEIGHT_PX, WIDTH_PX, 3):
        raise ValueError(
            f"frames are {frames.dtype}{list(frames.shape)}, expected uint8[..., {HEIGHT_PX}, {WIDTH_PX}, 3]"
        )
    cut = frames.reshape(-1, HEIGHT_PX, WIDTH_PX, 3)[:, :, : COLS * BLOCK_PX]
    rows = cut.reshape(-1, ROWS, BLOCK_PX, COLS * BLOCK_PX * 3).sum(2, dtype=np.uint16)
    blocks = rows.reshape(-1, ROWS, COLS, BLOCK_PX, 3).sum(3, dtype=np.uint16)
    pooled = np.stack([blocks[..., 1], blocks[..., 0] + blocks[..., 2]], axis=1)
    return pooled.reshape(*lead, CHANNELS, ROWS, COLS)


def selector() -> NDArray[np.int8]:
    """Which bytes of a row of a BGR frame belong to which sum: int8 [327 * 3, 2 * 65] of zeros and ones.

    The last columns, which fill no block, belong to none.
    """
    row = np.zeros((WIDTH_PX, 3, CHANNELS, COLS), np.int8)
    column = np.arange(COLS * BLOCK_PX)
    row[column, 1, 0, column // BLOCK_PX] = 1
    for colour in (0, 2):
        row[column, colour, 1, column // BLOCK_PX] = 1
    return row.reshape(WIDTH_PX * 3, CHANNELS * COLS)


@torch.library.custom_op("tactile_insertion::block_sums", mutates_args=())
def block_sums(frames: Tensor) -> Tensor:
    """Block sums of BGR frames inside the graph: uint8 [N, 320, 327, 3] -> float32 [N, 2, 64, 65].

    An operator of its own, so that the exporter writes it as one product of integers (:func:`selector`): a quarter of
    the time that casting and adding takes.
    """
    cut = frames[:, :, : COLS * BLOCK_PX].reshape(-1, ROWS, BLOCK_PX, COLS, BLOCK_PX, 3)
    blocks = cut.float().sum((2, 4))
    return torch.stack([blocks[..., 1], blocks[..., 0] + blocks[..., 2]], 1)


@block_sums.register_fake
def _(frames: Tensor) -> Tensor:
    return frames.new_empty((frames.shape[0], CHANNELS, ROWS, COLS), dtype=torch.float32)
