"""What the Open Inference Protocol's routes answer is what KServe's own models of the protocol read, and the other way.

KServe is large and not needed to run anything: ``KSERVE_PYTHON`` names an interpreter that has it (`make peers`).
"""

import json
import os
import subprocess

import httpx
import numpy as np
import pytest

from tests.service.conftest import LiveService

MODEL = "direction.step"
SCRIPT = """
import json, sys
from kserve.protocol.rest import v2_datamodels as models
said = json.load(sys.stdin)
for name, text in said["answers"]:
    getattr(models, name).model_validate_json(text, strict=True)
tensors = [models.RequestInput(**one) for one in said["inputs"]]
print(models.InferenceRequest(id="seven", inputs=tensors).model_dump_json(exclude_none=True))
"""


def kserve(answers: list[tuple[str, str]], inputs: list[dict[str, object]]) -> bytes:
    """A request as KServe writes it, of these inputs, once it has read these answers."""
    python = os.environ.get("KSERVE_PYTHON")
    if not python:
        pytest.skip("set KSERVE_PYTHON to a Python with kserve (make peers does)")
    request = json.dumps({"answers": answers, "inputs": inputs}).encode()
    done = subprocess.run([python, "-c", SCRIPT], input=request, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


def test_kserve_reads_every_answer_and_writes_a_request_that_is_answered(live: LiveService) -> None:
    def ask(path: str) -> str:
        return httpx.get(live.url(f"/v2{path}"), headers=live.bearer).raise_for_status().text

    answers = [
        ("ServerMetadataResponse", ask("")),
        ("ServerLiveResponse", ask("/health/live")),
        ("ServerReadyResponse", ask("/health/ready")),
        ("ModelMetadataResponse", ask(f"/models/{MODEL}")),
        ("ModelReadyResponse", ask(f"/models/{MODEL}/ready")),
    ]
    frame = np.zeros((1, 2, 320, 327, 3), np.uint8)
    inputs = [
        {"name": name, "datatype": kind, "shape": list(values.shape), "data": np.ravel(values).tolist()}
        for name, kind, values in (
            ("frame", "UINT8", frame),
            ("reference", "UINT8", frame),
            ("state", "FP32", np.ones((1, 6), np.float32)),
        )
    ]
    request = kserve(answers, inputs)
    path = live.url(f"/v2/models/{MODEL}/infer")
    head = live.bearer | {"Content-Type": "application/json"}
    answer = httpx.post(path, content=request, headers=head, timeout=60).raise_for_status()
    assert answer.json()["id"] == "seven"
    kserve([("InferenceResponse", answer.text)], inputs[2:])
