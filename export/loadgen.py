"""MLPerf LoadGen as a library: SingleStream, Offline and Server on one model, its summary read back."""

import array
import tempfile
from pathlib import Path
from typing import Any, Literal

from export.measure import example_inputs
from export.verify import Model
from service.contract import ContractError

Scenario = Literal["SingleStream", "Offline", "Server"]
SCENARIOS: tuple[Scenario, ...] = ("SingleStream", "Offline", "Server")
SERVER_QUERIES = 500
SAMPLES = 64


def available() -> bool:
    """Whether LoadGen is installed (pip package mlcommons-loadgen)."""
    try:
        import mlperf_loadgen  # noqa: F401
    except ImportError:
        return False
    return True


def run_scenario(model: Model, scenario: Scenario, *, seconds: float, expected_ms: float) -> dict[str, str]:
    """Run one scenario; the lines of LoadGen's own summary as name -> value."""
    try:
        import mlperf_loadgen as lg
    except ImportError as error:
        raise ContractError("LoadGen is not installed; expected the pip package mlcommons-loadgen") from error
    inputs = example_inputs(model)

    def issue(queries: Any) -> None:
        for query in queries:
            model(inputs)
            answer = array.array("B", b"1")
            lg.QuerySamplesComplete([lg.QuerySampleResponse(query.id, answer.buffer_info()[0], 1)])

    sut = lg.ConstructSUT(issue, lambda: None)
    library = lg.ConstructQSL(SAMPLES, SAMPLES, lambda _: None, lambda _: None)
    try:
        with tempfile.TemporaryDirectory() as folder:
            lg.StartTestWithLogSettings(sut, library, _settings(lg, scenario, seconds, expected_ms), _log(lg, folder))
            return _summary(Path(folder) / "mlperf_log_summary.txt")
    finally:
        lg.DestroyQSL(library)
        lg.DestroySUT(sut)


def _settings(lg: Any, scenario: Scenario, seconds: float, expected_ms: float) -> Any:
    settings = lg.TestSettings()
    settings.scenario = getattr(lg.TestScenario, scenario)
    settings.mode = lg.TestMode.PerformanceOnly
    settings.min_duration_ms = int(seconds * 1e3)
    settings.min_query_count = SERVER_QUERIES if scenario == "Server" else 100
    settings.single_stream_expected_latency_ns = int(expected_ms * 1e6)
    settings.offline_expected_qps = 1e3 / expected_ms
    settings.server_target_qps = 0.3 * 1e3 / expected_ms  # a third of capacity: the queue must stay short
    settings.server_target_latency_ns = int(20 * expected_ms * 1e6)
    return settings


def _log(lg: Any, folder: str) -> Any:
    output = lg.LogOutputSettings()
    output.outdir = folder
    output.copy_summary_to_stdout = False
    settings = lg.LogSettings()
    settings.log_output = output
    settings.enable_trace = False
    return settings


def _summary(path: Path) -> dict[str, str]:
    pairs = (line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    return {name.strip(): value.strip() for name, value in pairs}
