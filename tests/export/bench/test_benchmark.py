import gc
import json
import os
from pathlib import Path

import numpy as np
import pytest

from export.bench.benchmark import benchmark
from export.bench.measure import quartiles, time_in_turn, undisturbed
from export.bench.paper import exported
from export.bench.report import benchmark_page
from service.contract import ContractError


@pytest.fixture(scope="module")
def report(models, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    benchmark([models / "direction.step.onnx"], seconds=0.02, docs=out, int8=models / "pair")
    return json.loads((out / "benchmark.json").read_text())


def test_a_model_has_its_times(report):
    (row,) = report["models"]
    assert 0 < row["p50_ms"] <= row["p99_ms"]


def test_every_mode_of_int8_has_a_row_with_a_verdict(report):
    rows = report["int8"]
    assert [row["precision"] for row in rows] == ["fp32", "int8 static", "int8 dynamic", "int8 blocked"]
    assert rows[0]["same_commands"] == rows[0]["decisions"] == 2
    text = benchmark_page(report)
    assert "golden frames, which decide nothing" in " ".join(text.split())
    assert text.count(" pays |") + text.count("does not pay |") == 3


def test_a_build_that_this_processor_computes_wrongly_has_its_reason_in_the_place_of_figures(
    models, tmp_path, monkeypatch
):
    monkeypatch.setattr("export.quantise.quantise.FAR_OFF", 0.0)
    benchmark([models / "direction.step.onnx"], seconds=0.02, docs=tmp_path, int8=models / "pair")
    page = (tmp_path / "benchmark.md").read_text()
    assert page.count("| - | - | - | refused: pair.step.onnx:") == 3


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(ContractError, match="no model at"):
        benchmark([tmp_path / "absent.onnx"], seconds=0.05, docs=tmp_path)


def test_what_cannot_be_measured_is_refused_by_name(tmp_path):
    with pytest.raises(ContractError, match="no network to measure"):
        benchmark([], seconds=0.05, docs=tmp_path)
    for folder in (Path("models/pressing"), Path("models/joint"), tmp_path):  # of depth, no command, none
        with pytest.raises(ContractError, match=f"--int8 {folder}: expected step networks of direction and magnitude"):
            benchmark([Path("models/pressing/pair.step.onnx")], seconds=0.02, docs=tmp_path, int8=folder)


def test_a_model_costs_as_much_as_itself():
    values = np.random.default_rng(0).normal(size=(120, 120))
    rows = time_in_turn({"one": lambda: values @ values, "other": lambda: values @ values}, seconds=0.05)
    middle, low, high = quartiles(rows["one"][1][1], rows["other"][1][1])
    assert 0.3 < middle < 3
    assert low <= middle <= high


def test_measuring_leaves_cores_and_collector_as_they_were():
    cores = os.sched_getaffinity(0)
    with undisturbed():
        assert len(os.sched_getaffinity(0)) == 1
        assert not gc.isenabled()
    assert os.sched_getaffinity(0) == cores
    assert gc.isenabled()


def test_the_page_says_which_speed_claim_holds(report):
    row = {"folder": "models", "cpu_p50_ms": 12.0}
    rows = [row | {"ratio": (share, 0.004, 0.008)} for share in (0.0066, 0.0067)]
    text = benchmark_page(report | {"alexnet": {"trained": False, "passes_cpu_ms": 300.0, "rows": rows}})
    assert "of random weights (speed only)" in " ".join(text.split())
    assert "| 1/152 (1/125 .. 1/250) | holds |" in text
    assert "| 1/149 (1/125 .. 1/250) | does not hold |" in text
    assert "The bound is 1/150." in " ".join(text.split())


def test_half_an_export_of_the_paper_s_networks_is_named(tmp_path):
    (tmp_path / "direction.sequence.onnx").touch()
    with pytest.raises(ContractError, match=r"magnitude\.sequence\.onnx is missing; export the checkpoint again"):
        exported(tmp_path)
