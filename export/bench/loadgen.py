"""MLPerf LoadGen as a library: SingleStream, Offline and Server on one model, then its accuracy mode.

In the performance scenarios a sample is one call; in accuracy mode it is a whole recorded decision, and what LoadGen
logged of the answers is scored, not what this program remembers of them.
"""

import array
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from export.bench.measure import example_inputs, time_calls
from export.onnx.model import Model
from service.contract import ContractError

Scenario = Literal["SingleStream", "Offline", "Server"]
SCENARIOS: tuple[Scenario, ...] = ("SingleStream", "Offline", "Server")
SERVER_QUERIES = 500
"""LoadGen's early stopping needs 459 queries before it states a p99 for the Server scenario."""
LEAST_QUERIES = 100
SAMPLES = 64
Answer = Callable[[int], int]


def available() -> bool:
    """Whether LoadGen is installed (pip package mlcommons-loadgen)."""
    try:
        import mlperf_loadgen  # noqa: F401
    except ImportError:
        return False
    return True


def run_scenario(model: Model, scenario: Scenario, *, seconds: float) -> dict[str, str]:
    """Run one scenario on golden inputs; the lines of LoadGen's own summary as name -> value.

    Added are ``CPU p50 (ms)`` and ``CPU p99 (ms)`` of the queries, by the clock of the thread that answered them.
    """
    inputs = example_inputs(model)
    spent_ms: list[float] = []

    def answer(_sample: int) -> int:
        began = time.thread_time_ns()
        model(inputs)
        spent_ms.append((time.thread_time_ns() - began) / 1e6)
        return 1

    timing = time_calls(lambda: model(inputs), seconds=0.2, least=10)
    with tempfile.TemporaryDirectory() as folder:
        _start(answer, SAMPLES, Path(folder), lambda lg: _performance(lg, scenario, seconds, timing.p50_ms))
        summary = _summary(Path(folder) / "mlperf_log_summary.txt")
    return summary | {f"CPU p{share} (ms)": f"{np.percentile(spent_ms, share):.6f}" for share in (50, 99)}


def run_accuracy(answer: Answer, labels: Sequence[int]) -> tuple[int, int]:
    """LoadGen's accuracy mode over recorded decisions; (right, all) of the answers in its log."""
    with tempfile.TemporaryDirectory() as folder:
        _start(answer, len(labels), Path(folder), _accuracy)
        logged = json.loads((Path(folder) / "mlperf_log_accuracy.json").read_text())
    answers = {row["qsl_idx"]: int(np.frombuffer(bytes.fromhex(row["data"]), np.int32)[0]) for row in logged}
    if set(answers) != set(range(len(labels))):
        raise ContractError(f"LoadGen logged {len(answers)} answers, expected {len(labels)}")
    return sum(int(answers[index] == label) for index, label in enumerate(labels)), len(labels)


def _start(answer: Answer, samples: int, folder: Path, settings: Callable[[Any], Any]) -> None:
    try:
        import mlperf_loadgen as lg
    except ImportError as error:
        raise ContractError("LoadGen is not installed; expected the pip package mlcommons-loadgen") from error

    def issue(queries: Any) -> None:
        for query in queries:
            reply = array.array("B", np.int32(answer(query.index)).tobytes())
            address, length = reply.buffer_info()
            lg.QuerySamplesComplete([lg.QuerySampleResponse(query.id, address, length)])

    sut = lg.ConstructSUT(issue, lambda: None)
    library = lg.ConstructQSL(samples, samples, lambda _: None, lambda _: None)
    try:
        lg.StartTestWithLogSettings(sut, library, settings(lg), _log(lg, folder))
    finally:
        lg.DestroyQSL(library)
        lg.DestroySUT(sut)


def _accuracy(lg: Any) -> Any:
    settings = lg.TestSettings()
    settings.scenario = lg.TestScenario.SingleStream
    settings.mode = lg.TestMode.AccuracyOnly
    return settings


def _performance(lg: Any, scenario: Scenario, seconds: float, expected_ms: float) -> Any:
    settings = lg.TestSettings()
    settings.scenario = getattr(lg.TestScenario, scenario)
    settings.mode = lg.TestMode.PerformanceOnly
    settings.min_duration_ms = int(seconds * 1e3)
    settings.min_query_count = SERVER_QUERIES if scenario == "Server" else LEAST_QUERIES
    # LoadGen draws its queries before the run: a faster second half of the run must not exhaust them.
    settings.single_stream_expected_latency_ns = int(expected_ms * 1e6 / 2)
    settings.offline_expected_qps = 1.5e3 / expected_ms
    settings.server_target_qps = 0.3 * 1e3 / expected_ms  # a third of capacity: the queue must stay short
    settings.server_target_latency_ns = int(20 * expected_ms * 1e6)
    return settings


def _log(lg: Any, folder: Path) -> Any:
    output = lg.LogOutputSettings()
    output.outdir = str(folder)
    output.copy_summary_to_stdout = False
    settings = lg.LogSettings()
    settings.log_output = output
    settings.enable_trace = False
    return settings


def _summary(path: Path) -> dict[str, str]:
    pairs = (line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    return {name.strip(): value.strip() for name, value in pairs}
