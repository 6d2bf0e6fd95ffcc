import pytest

from tests.training.synthetic import SyntheticSource
from training.config import DataConfig, RunConfig, StageConfig
from training.fit import usual
from training.fit.train import train
from training.networks.settings import NetworkConfig

FRAMES = NetworkConfig(front_width=8, trunk_width=8, feature_size=16, state_size=16)
MARKERS = NetworkConfig(kind="markers", trunk_width=8, feature_size=16, state_size=16)
PRESSING = NetworkConfig(kind="pressing", trunk_width=8, feature_size=16, state_size=16, affine_fit=True)


@pytest.fixture(scope="session")
def source():
    return SyntheticSource()


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Cache of drawn pictures, shared by all tests; file names identify the contents."""
    return tmp_path_factory.mktemp("drawn")


@pytest.fixture(scope="session")
def trained(source, cache, tmp_path_factory):
    """A tiny run that is done: its config and its checkpoint. Its folder is to be read alone."""
    config = tiny(tmp_path_factory.mktemp("trained"), cache)
    return config, train(config, source)


@pytest.fixture(scope="session", autouse=True)
def usual_fields_in_few_steps():
    """The model of usual fields is fitted in less than a second: it tells faults from usual presses by then."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(usual, "FITTED", 300)
        yield


@pytest.fixture
def config(tmp_path, cache):
    return tiny(tmp_path, cache)


def tiny(folder, cache):
    stage = StageConfig(epochs=2, batch=16, learning_rate=2e-3)
    return RunConfig(
        name="tiny",
        runs=str(folder / "runs"),
        data=DataConfig(
            path="unused",
            cache=str(cache),
            rendered_training=4,
            rendered_validation=3,
            rendered_test=2,
        ),
        network=FRAMES,
        front=stage,
        trunk=stage,
        tune=stage,
    )
