"""One process of test_parallel.py, started by torchrun: trains the tiny network, leaves its own weights in FOLDER."""

import sys
from pathlib import Path

import torch

from tests.training.synthetic import SyntheticSource
from training.config import DataConfig, RunConfig, StageConfig
from training.fit import parallel, train
from training.networks.settings import NetworkConfig

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    stage = StageConfig(epochs=1, batch=16, learning_rate=2e-3)
    data = DataConfig(path="unused", cache=str(folder / "cache"), rendered_training=8, rendered_validation=4)
    network = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
    config = RunConfig(name="two", runs=str(folder), data=data, network=network, front=stage, trunk=stage, tune=stage)
    ranks, kept = [], train._finish

    def finish(trainer, home):
        ranks.append(parallel.rank())
        return kept(trainer, home)

    train._finish = finish
    checkpoint = train.train(config, SyntheticSource())
    torch.save(checkpoint.weights, folder / f"weights-{ranks[0]}.pt")
