import gc
import json
import os
from pathlib import Path

import numpy as np
import pytest

from export.bench import loadgen
from export.bench import report as page
from export.bench.benchmark import benchmark
from export.bench.fresh import measure_fresh
from export.bench.measure import Timing, example_inputs, quartiles, time_in_turn, undisturbed
from export.bench.paper import RELEASED_SHARE, SEQUENCES, exported
from export.bench.peers import PeerAbsentError, peer, rebuild
from export.bench.report import write
from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from service.contract import ContractError


@pytest.fixture(scope="module")
def report(models, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    files = [models / "direction.step.onnx"]
    benchmark(files, seconds=0.02, docs=out, compare=("torch",), with_loadgen=False)
    return out


def test_the_benchmark_reports_every_figure(report):
    report_ = json.loads((report / "benchmark.json").read_text())
    (row,) = report_["models"]
    single = row["single"]
    assert 0 < single["p50_ms"] <= single["p90_ms"] <= single["p99_ms"] <= single["p999_ms"]
    assert row["operators_ms"]
    assert [(entry["threads"], entry["spinning"]) for entry in row["sweep"]] == [
        (1, False),
        (1, True),
        (2, False),
        (2, True),
    ]
    assert row["fresh"]["first_ms"] > 0
    assert row["steady"]["tail"] >= 1.0
    assert row["steady"]["machine_tail"] >= 1.0
    assert report_["peers"]["rows"]["torch"]["cpu_p50_ms"] > 0


def test_one_page_and_one_figure_hold_it(report):
    text = (report / "benchmark.md").read_text()
    for heading in ("One call", "Threads and spinning", "Against other runtimes"):
        assert f"## {heading}" in text
    assert (report / "benchmark.png").stat().st_size > 5_000


@pytest.mark.parametrize(("calls", "cell"), [(226, "| too few |"), (1000, "| 7.64 |")])
def test_the_slowest_of_a_thousand_is_not_read_off_fewer_calls(calls, cell):
    times = dict.fromkeys(("p50_ms", "p90_ms", "p99_ms", "cpu_p50_ms", "cpu_p99_ms"), 4.0)
    steady = {"tail": 1.2, "machine_tail": 1.1}
    row = {"single": times | {"p999_ms": 7.64, "calls": calls}, "steady": steady, "file": "a.onnx", "size_mb": 1.0}
    row |= {"fresh": {"load_ms": 9.0, "first_ms": 2.0, "peak_mb": 3.0}, "card": {"quantisation": "none"}}
    assert cell in page._calls([row]).markdown()


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(ContractError, match="no model at"):
        benchmark([tmp_path / "absent.onnx"], seconds=0.05, docs=tmp_path)
    with pytest.raises(ContractError, match=r"no model at .*absent\.onnx"):
        measure_fresh(tmp_path / "absent.onnx")


def test_the_memory_of_a_fresh_process_is_that_of_its_first_opening():
    """A session takes some ten megabytes whatever its model; opened before, it would find them already taken."""
    assert measure_fresh(Path("models/direction.step.onnx"))["peak_mb"] > 6


def test_an_unknown_peer_is_named(models):
    with pytest.raises(ContractError, match=r"no peer tensorflow, expected some of torch, openvino"):
        peer("tensorflow", open_model(models / "direction.step.onnx"))


def test_torch_is_rebuilt_from_the_released_file_alone(models):
    for name in ("direction.sequence.onnx", "joint/joint.step.onnx", "pair/pair.step.onnx"):
        peer("torch", open_model(models / name))()


@pytest.mark.parametrize("name", ["direction", "magnitude", "joint/joint", "pictures/magnitude"])
def test_torch_computes_what_a_released_step_does(name):
    model = open_model(Path("models") / f"{name}.step.onnx")
    outputs = model(example_inputs(model)).values()
    for ours, theirs in zip(outputs, peer("torch", model)(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_torch_rebuilds_no_int8_file(models):
    model = open_model(models / "direction.step.onnx")
    int8 = model.card.model_copy(update={"quantisation": "int8"})
    with pytest.raises(PeerAbsentError, match="torch has no int8 build"):
        rebuild(type(model)(model.file, int8, model.run))


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


def test_a_crowded_machine_is_called_noisy():
    cpu = np.full(100, 2.0)
    assert Timing.of(cpu * 2, cpu).noisy
    assert not Timing.of(cpu * 1.1, cpu).noisy


def test_a_budget_is_held_against_the_wall_clock_unless_neighbours_stretch_it():
    cpu = np.linspace(2.0, 2.2, 100)
    assert Timing.of(cpu * 1.1, cpu).budget_p99_ms == pytest.approx(2.2 * 1.1, rel=0.01)
    stretched = cpu.copy()
    stretched[-3:] = 30.0
    assert Timing.of(stretched, cpu).budget_p99_ms == pytest.approx(2.2, rel=0.01)


def test_the_page_says_which_speed_claim_holds(report):
    page = json.loads((report / "benchmark.json").read_text())
    row = {"files": ["x.onnx"], "cpu_p50_ms": 12.0}
    page["alexnet"] = {
        "trained": False,
        "passes_cpu_ms": 300.0,
        "rows": [
            row | {"what": "released: models", "ratio": (0.005, 0.004, 0.006), "claim": 1 / 150},
            row | {"what": "released: others", "ratio": (0.05, 0.04, 0.06), "claim": 1 / 150},
            row | {"what": "shared backbone fp32", "ratio": (0.05, 0.04, 0.06), "claim": None},
        ],
    }
    write(page, report)
    text = (report / "benchmark.md").read_text()
    assert "of random weights (speed only)" in text
    assert "| 1/200 (1/167 .. 1/250) | 1/150: holds |" in text
    assert "| 1/20 (1/17 .. 1/25) | 1/150: does not hold |" in text
    assert "| 1/20 (1/17 .. 1/25) |  |" in text


def test_half_an_export_of_the_paper_s_networks_is_named(tmp_path):
    (tmp_path / "direction.sequence.onnx").touch()
    with pytest.raises(ContractError, match=r"magnitude\.sequence\.onnx is missing; export the checkpoint again"):
        exported(tmp_path, SEQUENCES)


def test_the_claim_is_that_of_the_design():
    assert 1 / RELEASED_SHARE == 150.0


needs_loadgen = pytest.mark.skipif(not loadgen.available(), reason="mlcommons-loadgen is not installed")


@pytest.mark.slow
@needs_loadgen
@pytest.mark.parametrize("scenario", loadgen.SCENARIOS)
def test_loadgen_accepts_a_run(models, scenario):
    summary = loadgen.run_scenario(open_model(models / "direction.step.onnx"), scenario, seconds=0.5)
    assert summary["Min duration satisfied"] == "Yes"
    assert summary["Min queries satisfied"] == "Yes"


@needs_loadgen
def test_loadgen_scores_what_it_logged():
    assert loadgen.run_accuracy(lambda index: index % 3, [0, 1, 2, 1]) == (3, 4)


@pytest.mark.slow
@needs_loadgen
def test_accuracy_comes_from_the_same_run(models, tmp_path):
    model = open_model(models / "direction.step.onnx")
    truth = np.array([8.0, 0.0], np.float32)
    decisions = [
        Decision(golden_frames(model.card.frame, 8, seed), 56.0, 30.0, truth, "rectangle") for seed in range(3)
    ]
    report = benchmark([model.file], seconds=0.05, docs=tmp_path, decisions=decisions)
    assert report["models"][0]["loadgen"]["accuracy"]["decisions"] == 3
