"""Models are replaced whole or not at all, between insertions, while the service runs."""

import shutil
from collections.abc import Iterator

import httpx
import onnx
import pytest

from tests.service import tiny_models
from tests.service.client import Driver
from tests.service.conftest import LiveService, live_service

LOAD = "/v2/repository/models/direction.step/load"


@pytest.fixture(scope="module")
def swappable(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    folder = tmp_path_factory.mktemp("swap")
    tiny_models.write_models(folder / "models")
    with live_service(folder, folder / "models") as service:
        yield service


def hashes(live: LiveService) -> list[str]:
    return [entry["sha256"] for entry in httpx.get(live.url("/v1/models")).json()["models"]]


def test_new_models_decide_the_next_insertion(swappable: LiveService) -> None:
    before = hashes(swappable)
    folder = swappable.station.settings.models
    onnx.save(tiny_models.step_model("direction", seed=7), str(folder / "direction.step.onnx"))
    assert httpx.post(swappable.url(LOAD), headers=swappable.bearer).status_code == 200
    after = hashes(swappable)
    assert after != before
    driver = Driver(swappable, "swapped")
    assert [entry.sha256 for entry in driver.until("hello").models] == after
    driver.attempt(1)
    assert driver.insert(2).outcome == "inserted"
    driver.close()


@pytest.mark.parametrize("fault", ["garbage", "no card", "missing", "dangling", "disagreement", "other size"])
def test_whatever_is_wrong_with_the_new_ones_the_old_ones_stay(swappable: LiveService, fault: str) -> None:
    folder = swappable.station.settings.models
    path = folder / "magnitude.step.onnx"
    spare = shutil.copytree(folder, folder.parent / f"spare-{fault}")
    before, running = hashes(swappable), swappable.station.models
    match fault:
        case "garbage":
            path.write_bytes(b"no model")
        case "no card":
            model = onnx.load(str(path))
            del model.metadata_props[:]
            onnx.save(model, str(path))
        case "missing":
            path.unlink()
        case "dangling":
            path.unlink()
            path.symlink_to("nowhere")
        case "disagreement":
            onnx.save(tiny_models.step_model("magnitude", frames_per_decision=6), str(path))
        case _:
            smaller = tiny_models.SPEC.model_copy(update={"width_px": 300})
            tiny_models.write_models(folder, frame=smaller)
    refused = httpx.post(swappable.url(LOAD), headers=swappable.bearer)
    path.unlink(missing_ok=True)
    shutil.copytree(spare, folder, dirs_exist_ok=True)
    assert refused.status_code == 400
    assert refused.json()["error"]
    assert hashes(swappable) == before
    assert swappable.station.models is running
