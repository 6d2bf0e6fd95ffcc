import json

import numpy as np
import pytest

from export import loadgen
from export.benchmark import benchmark
from export.measure import Timing, paired_ratio
from export.verify import open_model
from service.contract import ContractError


def test_the_benchmark_reports_every_figure(models, tmp_path):
    out = tmp_path / "benchmark.json"
    benchmark([models / "direction.step.onnx"], seconds=0.05, out=out, with_loadgen=False)
    (row,) = json.loads(out.read_text())["models"]
    single = row["single"]
    assert 0 < single["p50_ms"] <= single["p90_ms"] <= single["p99_ms"] <= single["p999_ms"]
    assert row["operators_ms"]
    assert set(row["threads"]) == {"1", "2"}


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(ContractError, match="no model at"):
        benchmark([tmp_path / "absent.onnx"], seconds=0.05, out=None, with_loadgen=False)


def test_a_model_costs_as_much_as_itself():
    values = np.random.default_rng(0).normal(size=(120, 120))
    middle, low, high = paired_ratio(lambda: values @ values, lambda: values @ values)
    assert 0.5 < middle < 2
    assert low <= middle <= high


def test_a_crowded_machine_is_called_noisy():
    cpu = np.full(100, 2.0)
    assert Timing.of(cpu * 2, cpu).noisy
    assert not Timing.of(cpu * 1.1, cpu).noisy


@pytest.mark.slow
@pytest.mark.skipif(not loadgen.available(), reason="mlcommons-loadgen is not installed")
@pytest.mark.parametrize("scenario", loadgen.SCENARIOS)
def test_loadgen_accepts_a_run(models, scenario):
    model = open_model(models / "direction.step.onnx")
    summary = loadgen.run_scenario(model, scenario, seconds=0.5, expected_ms=3.0)
    assert summary["Result is"] == "VALID"
