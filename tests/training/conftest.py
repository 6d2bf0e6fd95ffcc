import pytest

from tests.training.synthetic import SyntheticSource
from training.config import DataConfig, RunConfig, StageConfig
from training.networks.settings import NetworkConfig


@pytest.fixture(scope="session")
def source():
    return SyntheticSource()


@pytest.fixture
def config(tmp_path):
    stage = StageConfig(epochs=2, batch=16, learning_rate=2e-3)
    return RunConfig(
        name="tiny",
        runs=str(tmp_path / "runs"),
        data=DataConfig(
            path="unused",
            cache=str(tmp_path / "cache"),
            rendered_training=10,
            rendered_validation=5,
            rendered_test=5,
        ),
        network=NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16),
        front=stage,
        trunk=stage,
        tune=stage,
    )
