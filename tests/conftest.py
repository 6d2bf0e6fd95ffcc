"""For every test: properties are judged by what holds, never by how fast the machine shows it.

The fast tests draw the same 50 examples on every machine, so that a change is judged by what it changed. `make
test-all` sets HYPOTHESIS_PROFILE=explore and draws 100 new ones each time. Each process computes on one thread: workers
and services share the machine's cores.
"""

import os
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from service.session.memory import stop_searching_what_stays

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when numpy and torch are imported
STATE = tempfile.TemporaryDirectory(prefix="tactile-state-")  # until this process ends
os.environ["TACTILE_STATE"] = STATE.name  # never the token of who runs the tests
# All servers are the tests' own; otherwise each client would read the machine's 150 authorities in 50 ms.
os.environ["SSL_CERT_FILE"] = str(Path(__file__).with_name("authority.pem"))

settings.register_profile("explore", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("same everywhere", parent=settings.get_profile("explore"), derandomize=True, max_examples=50)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same everywhere"))


def pytest_collection_finish() -> None:
    """As the service does: searching all that was imported would stop every thread for a third of a second."""
    stop_searching_what_stays()


@pytest.fixture
def anyio_backend() -> str:
    """Tests that are coroutines run on the event loop of the product."""
    return "asyncio"


@pytest.fixture(scope="session")
def models_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Tiny networks, as a folder."""
    from tests.service import tiny_models

    return tiny_models.write_models(tmp_path_factory.mktemp("models") / "tiny")


@pytest.fixture(scope="session")
def models(models_folder: Path) -> Any:
    """The same, as the service loads them."""
    from service.decision.models import load_models

    return load_models(models_folder)
