import numpy as np
import pytest
import torch

from service.contract import Sensor
from training.networks.preprocessing import block_sums, pool_frames

SENSOR = Sensor.load()


def test_pooling_in_the_graph_equals_the_cache_bit_for_bit():
    frames = np.random.default_rng(0).integers(0, 256, (3, 2, 320, 327, 3), dtype=np.uint8)
    frames[0] = 255
    graph = block_sums(torch.from_numpy(frames.reshape(6, 320, 327, 3)), 5).numpy()
    assert np.array_equal(graph, pool_frames(frames, SENSOR).reshape(6, 2, 64, 65).astype(np.float32))


def test_pooled_values_are_block_sums_of_green_and_of_blue_and_red():
    frame = np.zeros((320, 327, 3), np.uint8)
    frame[5:10, 10:15] = (1, 2, 4)
    pooled = pool_frames(frame, SENSOR)
    assert pooled[0, 1, 2] == 50
    assert pooled[1, 1, 2] == 125
    assert pooled.sum() == 175


@pytest.mark.parametrize("shape", [(320, 320, 3), (327, 320, 3), (320, 327)])
def test_frames_of_another_shape_are_refused(shape):
    with pytest.raises(ValueError, match="expected uint8"):
        pool_frames(np.zeros(shape, np.uint8), SENSOR)


def test_float_frames_are_refused():
    with pytest.raises(ValueError, match="expected uint8"):
        pool_frames(np.zeros((320, 327, 3), np.float32), SENSOR)
