import gzip
import json
from typing import Any

import httpx
import jsonschema_rs
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.service.conftest import LiveService

triton = pytest.importorskip("tritonclient.http")  # the stock client is no dependency of the product

MODEL = "direction.step"
SHAPE = [1, 2, 320, 327, 3]


def inputs(binary: bool) -> list:
    rng = np.random.default_rng(0)
    arrays = {
        "frame": rng.integers(0, 255, SHAPE, np.uint8),
        "reference": rng.integers(0, 255, SHAPE, np.uint8),
        "state": np.ones((1, 6), np.float32),
    }
    types = {"frame": "UINT8", "reference": "UINT8", "state": "FP32"}
    made = []
    for name, values in arrays.items():
        entry = triton.InferInput(name, list(values.shape), types[name])
        entry.set_data_from_numpy(values, binary_data=binary)
        made.append(entry)
    return made


def expected(live: LiveService) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    frame, reference = rng.integers(0, 255, SHAPE, np.uint8), rng.integers(0, 255, SHAPE, np.uint8)
    step = next(one for one in live.station.models.steps if one.card.role == "direction")
    return step.run({"frame": frame, "reference": reference, "state": np.ones((1, 6), np.float32)})


class Bearer(triton.InferenceServerClientPlugin):
    """The stock clients' own way to send a token."""

    def __init__(self, live: LiveService) -> None:
        self.header = live.bearer

    def __call__(self, request: Any) -> None:
        request.headers |= self.header


@pytest.fixture(scope="module")
def client(live: LiveService):
    with triton.InferenceServerClient(f"127.0.0.1:{live.port}", network_timeout=60.0) as made:
        made.register_plugin(Bearer(live))
        yield made


@pytest.mark.parametrize(
    ("binary", "packing"),
    [
        *((True, packing) for packing in (None, "gzip", "deflate")),
        (False, None),
        *(pytest.param(False, packing, marks=pytest.mark.slow) for packing in ("gzip", "deflate")),
    ],
)
def test_a_stock_client_gets_what_the_session_computes(
    live: LiveService, client, binary: bool, packing: str | None
) -> None:
    answer = client.infer(
        MODEL,
        inputs(binary),
        outputs=[triton.InferRequestedOutput("logits", binary_data=binary)],
        request_compression_algorithm=packing,
        response_compression_algorithm=packing,
        request_id="seven",
    )
    assert answer.get_response()["id"] == "seven"
    np.testing.assert_allclose(answer.as_numpy("logits"), expected(live)["logits"], rtol=1e-6)


def test_all_outputs_come_when_none_is_asked_for_and_one_may_be_binary_beside_one_in_json(
    live: LiveService, client
) -> None:
    wanted = expected(live)
    answer = client.infer(MODEL, inputs(binary=True))
    for name, values in wanted.items():
        np.testing.assert_allclose(answer.as_numpy(name), values, rtol=1e-6)
    mixed = [
        triton.InferRequestedOutput("logits", binary_data=True),
        triton.InferRequestedOutput("next_state", binary_data=False),
    ]
    answer = client.infer(MODEL, inputs(binary=False), outputs=mixed, model_version="1")
    for name in ("logits", "next_state"):
        np.testing.assert_allclose(answer.as_numpy(name), wanted[name], rtol=1e-6)


def test_an_answer_in_json_is_as_described(live: LiveService) -> None:
    tensors = [{"name": i.name(), "shape": i.shape(), "datatype": i.datatype()} for i in inputs(binary=False)]
    for tensor in tensors:
        tensor["data"] = np.ones(tensor["shape"], int).ravel().tolist()
    answer = httpx.post(live.url(f"/v2/models/{MODEL}/infer"), json={"inputs": tensors}, headers=live.bearer)
    described = httpx.get(live.url("/openapi.json")).json()["paths"]["/v2/models/{name}/infer"]["post"]["responses"]
    schema = described["200"]["content"]["application/json"]["schema"]
    assert answer.status_code == 200
    jsonschema_rs.validator_for(schema).validate(answer.json())


def test_statistics_count_successes_and_failures(live: LiveService, client) -> None:
    def counted() -> tuple[int, int]:
        (stats,) = client.get_inference_statistics(MODEL)["model_stats"]
        return stats["inference_stats"]["success"]["count"], stats["inference_stats"]["fail"]["count"]

    before = counted()
    client.infer(MODEL, inputs(binary=True))
    with pytest.raises(triton.InferenceServerException, match="expected each of"):
        client.infer(MODEL, inputs(binary=True)[:1] * 2)
    assert counted() == (before[0] + 1, before[1] + 1)


def test_several_stock_clients_at_once_get_their_own_answers(live: LiveService, client) -> None:
    calls = [client.async_infer(MODEL, inputs(binary=True), request_id=str(number)) for number in range(8)]
    answers = [call.get_result() for call in calls]
    assert [answer.get_response()["id"] for answer in answers] == [str(number) for number in range(8)]
    wanted = expected(live)["logits"]
    assert all(np.allclose(answer.as_numpy("logits"), wanted, rtol=1e-6) for answer in answers)


def test_a_stock_client_finds_every_endpoint(client) -> None:
    assert client.is_server_live()
    assert client.is_server_ready()
    assert client.is_model_ready(MODEL)
    assert client.is_model_ready(MODEL, "1")
    assert not client.is_model_ready("none")
    assert "binary_tensor_data" in client.get_server_metadata()["extensions"]
    assert client.get_model_metadata(MODEL)["inputs"][0]["shape"] == [-1, *SHAPE[1:]]
    assert client.get_model_config(MODEL)["name"] == MODEL
    assert client.get_model_repository_index()[0]["state"] == "READY"
    assert client.get_inference_statistics()["model_stats"]
    assert client.get_inference_statistics(MODEL)["model_stats"][0]["name"] == MODEL
    with pytest.raises(triton.InferenceServerException, match="unknown model none"):
        client.infer("none", inputs(binary=True))


def test_a_wrong_tensor_is_an_error_that_says_so(live: LiveService) -> None:
    path = live.url(f"/v2/models/{MODEL}/infer")
    body = {"inputs": [{"name": "state", "datatype": "FP32", "shape": [1, 7], "data": [0] * 7}]}
    answer = httpx.post(path, json=body, headers=live.bearer)
    assert answer.status_code == 400
    assert "shape [1, 7], expected [-1, 6]" in answer.json()["error"]


def state(**changes: object) -> dict[str, Any]:
    """A request that is right but for its missing frames, which are read after the state."""
    return {"inputs": [{"name": "state", "datatype": "FP32", "shape": [1, 6], "data": [0] * 6} | changes]}


@pytest.mark.parametrize("value", [None, float("nan"), float("inf"), 1e39])
def test_what_is_no_finite_number_is_refused_in_json(live: LiveService, value: float | None) -> None:
    body = json.dumps(state(data=[value] * 6))
    answer = httpx.post(live.url(f"/v2/models/{MODEL}/infer"), content=body, headers=live.bearer)
    assert answer.status_code == 400
    assert answer.json()["error"] == "input state has values that are not finite numbers"


def test_what_is_no_finite_number_is_refused_in_binary(client) -> None:
    asked = inputs(binary=True)
    asked[2].set_data_from_numpy(np.full((1, 6), np.nan, np.float32), binary_data=True)
    with pytest.raises(triton.InferenceServerException, match="not finite"):
        client.infer(MODEL, asked)


def test_a_stock_client_hears_which_parameter_is_not_supported(client) -> None:
    with pytest.raises(triton.InferenceServerException, match="parameter sequence_id is not supported"):
        client.infer(MODEL, inputs(binary=True), sequence_id=7, sequence_start=True)
    with pytest.raises(triton.InferenceServerException, match="parameter priority is not supported"):
        client.infer(MODEL, inputs(binary=True), priority=1)
    with pytest.raises(triton.InferenceServerException, match="parameter timeout is not supported"):
        client.infer(MODEL, inputs(binary=True), timeout=1000)
    classified = [triton.InferRequestedOutput("logits", class_count=3)]
    with pytest.raises(triton.InferenceServerException, match="parameter classification is not supported"):
        client.infer(MODEL, inputs(binary=True), outputs=classified)


@pytest.mark.parametrize(
    ("body", "named"),
    [
        (state() | {"priority": 1}, "request: priority"),
        (state() | {"parameters": {"sequence_end": True}}, "request: parameter sequence_end"),
        (state(parameters={"shared_memory_region": "x"}), "input state: parameter shared_memory_region"),
        (state(parameters=[1]), "parameters [1], expected an object"),
    ],
)
def test_every_key_that_is_not_read_is_refused_by_name(live: LiveService, body: dict[str, Any], named: str) -> None:
    answer = httpx.post(live.url(f"/v2/models/{MODEL}/infer"), json=body, headers=live.bearer)
    assert answer.status_code == 400
    assert named in answer.json()["error"]


KEYS = st.sampled_from(["name", "inputs", "datatype", "shape", "data", "parameters", "binary_data_size", "outputs"])
junk = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(KEYS, inner | st.sampled_from(["state", "frame", "FP32", "UINT8"]), max_size=5)
    ),
    max_leaves=12,
)


@pytest.mark.slow
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
@given(request=junk | st.fixed_dictionaries({"inputs": st.lists(junk, max_size=3)}), tail=st.binary(max_size=40))
def test_no_body_makes_the_server_fail(live: LiveService, request: object, tail: bytes) -> None:
    head = json.dumps(request).encode()
    for headers in ({}, {"Inference-Header-Content-Length": str(len(head))}, {"Content-Encoding": "gzip"}):
        content = gzip.compress(head + tail) if headers.get("Content-Encoding") else head + tail
        answer = httpx.post(live.url(f"/v2/models/{MODEL}/infer"), content=content, headers=live.bearer | headers)
        assert answer.status_code == 400
        assert answer.json()["error"]
