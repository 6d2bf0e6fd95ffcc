import gc
import json
import os
import time
from pathlib import Path

import numpy as np
import pytest

from export.bench import alexnet, loadgen
from export.bench import report as page
from export.bench.alexnet import files
from export.bench.benchmark import benchmark
from export.bench.fresh import measure_fresh
from export.bench.measure import (
    CALM,
    STEADY,
    Steadiness,
    Timing,
    calm_turns,
    example_inputs,
    quartiles,
    time_in_turn,
    undisturbed,
)
from export.bench.peers import PeerAbsentError, peer, rebuild
from export.bench.report import write
from export.limits import Layer, Peaks, Work, work_of
from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.yardstick import CLAIMS, SHARED
from service.contract import ContractError


@pytest.fixture(scope="module")
def report(models, tmp_path_factory):
    out = tmp_path_factory.mktemp("benchmark")
    files = [models / "direction.step.onnx"]
    benchmark(files, seconds=0.02, docs=out, compare=("torch",), with_loadgen=False)
    return out


def test_the_benchmark_reports_every_figure(report):
    (row,) = json.loads((report / "benchmark.json").read_text())["models"]
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
    assert row["steady"]["machine_tail"] >= 1.0
    assert 0.0 <= row["steady"]["calm_share"] <= 1.0
    assert row["steady"]["holds"] == (row["steady"]["tail"] <= STEADY), "every call counts"
    assert row["limit"]["shaped_ms"] > 0
    assert row["limit"]["limit_ms"] > 0
    assert row["peers"]["torch"]["cpu_p50_ms"] > 0


def test_slow_calls_of_a_model_show_in_calm_turns_too():
    ours, machine = np.ones((20, 32)), np.ones((20, 32))
    ours[5, :8] = 2.0  # 8 of 640 calls: more than one in a hundred
    found = Steadiness.of(ours, machine)
    assert (found.calm_share, found.tail_calm, found.steady) == (1.0, 2.0, False)


def test_turns_beside_a_disturbed_turn_of_the_machine_are_not_calm_and_still_judged():
    ours, machine = np.ones((20, 32)), np.ones((20, 32))
    machine[7, 3] = 2 * CALM
    ours[7, :8] = ours[8, :8] = 2.0  # between the disturbed arithmetic and its neighbours
    assert list(np.flatnonzero(~calm_turns(machine))) == [7, 8]
    found = Steadiness.of(ours, machine)
    assert (found.tail, found.tail_calm, found.steady) == (2.0, 1.0, False)


def test_turns_at_half_speed_are_not_calm_however_many_they_are():
    machine, ours = np.ones((20, 32)), np.ones((20, 32))
    machine[5:], ours[5:] = 2.0, 2.0
    found = Steadiness.of(ours, machine)
    assert (found.calm_share, found.tail_calm) == (0.25, 1.0)


def test_a_machine_that_is_never_calm_tells_nothing_of_calm_turns():
    machine = np.ones((20, 32))
    machine[:, 0] = 2 * CALM
    found = Steadiness.of(np.ones((20, 32)), machine)
    assert (found.tail_calm, found.steady, found.tail) == (None, True, 1.0)


def test_one_page_and_one_figure_hold_it(report):
    text = (report / "benchmark.md").read_text()
    for heading in ("One call", "Threads and spinning", "Against the hardware's limit", "Against other runtimes"):
        assert f"## {heading}" in text
    assert (report / "benchmark.png").stat().st_size > 5_000


@pytest.mark.parametrize(("calls", "cell"), [(226, "| too few |"), (1000, "| 7.64 |")])
def test_the_slowest_of_a_thousand_is_not_read_off_fewer_calls(calls, cell):
    times = dict.fromkeys(("p50_ms", "p90_ms", "p99_ms", "cpu_p50_ms", "cpu_p99_ms"), 4.0)
    steady = {"tail": 1.2, "tail_calm": 1.1, "machine_tail": 1.1, "holds": True}
    row = {"single": times | {"p999_ms": 7.64, "calls": calls}, "steady": steady, "file": "a.onnx", "size_mb": 1.0}
    row |= {"fresh": {"load_ms": 9.0, "first_ms": 2.0, "peak_mb": 3.0}, "card": {"quantisation": "none"}}
    assert cell in page._single(row)


def test_the_yardsticks_int8_follows_a_new_export(tmp_path, monkeypatch):
    """Made of random weights before the recipe was trained, it would be timed beside the trained ones for ever."""
    made = []
    monkeypatch.setattr(alexnet, "quantize", lambda source, out, _: made.append(source) or out.touch())
    monkeypatch.setattr(alexnet, "_calibration", lambda *_: [])
    for home in (tmp_path / "alexnet", tmp_path / "alexnet_shared"):
        (home / "pair" / "int8").mkdir(parents=True)
        for name in (*alexnet.SEQUENCES, alexnet.PAIR):
            (home / name).touch()
    for _ in range(2):
        alexnet.files(tmp_path / "alexnet")
    assert len(made) == 2
    later_s = time.time() + 10.0
    os.utime(tmp_path / "alexnet" / alexnet.PAIR, (later_s, later_s))
    alexnet.files(tmp_path / "alexnet")
    assert made[2:] == [tmp_path / "alexnet" / alexnet.PAIR]


def test_a_missing_model_is_named(tmp_path):
    with pytest.raises(ContractError, match="no model at"):
        benchmark([tmp_path / "absent.onnx"], seconds=0.05, docs=None)
    with pytest.raises(ContractError, match=r"no model at .*absent\.onnx"):
        measure_fresh(tmp_path / "absent.onnx")


def test_the_memory_of_a_fresh_process_is_that_of_its_first_opening():
    """A session takes some ten megabytes whatever its model; opened before, it would find them already taken."""
    assert measure_fresh(Path("models/direction.step.onnx"))["peak_mb"] > 6


def test_an_unknown_peer_is_named(models):
    with pytest.raises(ContractError, match=r"no peer tensorflow, expected some of torch, torch\.compile, openvino"):
        peer("tensorflow", open_model(models / "direction.step.onnx"))


def test_torch_is_rebuilt_from_the_released_file_alone(models):
    for name in ("direction.sequence.onnx", "joint/joint.step.onnx", "pair/pair.step.onnx"):
        peer("torch", open_model(models / name))()


@pytest.mark.parametrize("name", ["direction", "magnitude", "joint/joint", "pictures/magnitude"])
def test_the_torch_twin_of_a_released_step_says_what_the_file_says(name):
    model = open_model(Path("models") / f"{name}.step.onnx")
    said = model(example_inputs(model)).values()
    for ours, theirs in zip(said, peer("torch", model)(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_a_file_whose_weights_are_strangers_has_no_torch_twin(models):
    model = open_model(models / "direction.step.onnx")
    int8 = model.card.model_copy(update={"quantisation": "int8"})
    with pytest.raises(PeerAbsentError, match="torch has no int8 twin"):
        rebuild(type(model)(model.file, int8, model.run))


def test_the_limit_counts_every_multiplication_once(models):
    work = work_of(open_model(models / "direction.step.onnx"))
    # front: 4 -> 8 channels of 5 x 5, twice 8 -> 8 of 3 x 3, 8 -> 3 of 1 x 1, on 20 x 21 cells of two fingers
    front = 2 * 20 * 21 * (4 * 8 * 25 + 2 * 8 * 8 * 9 + 8 * 3)
    # pooling: 64 bands of five rows of 981 bytes by 130 columns, for frame and reference of two fingers
    pooling = 4 * 64 * 4905 * 130
    trunk = 2 * (10 * 11 * 8 * 3 * 9 + 5 * 6 * 16 * 8 * 9) + 2 * 480 * 16 + 35 * 48 + 16 * 48 + 16 * 9
    assert sum(layer.products for layer in work.layers) == front + pooling + trunk


def test_a_layer_costs_the_slower_of_arithmetic_and_memory():
    peaks = Peaks(fp32_gflops=1.0, int8_gops=10.0, read_gb_s=1.0)
    slow, large = Layer(2, 10, 500, 500, small=False), Layer(1, 1, 2000, 2000, small=True)
    assert Work((slow, large)).limit_ms(peaks) == pytest.approx(10.0 + 4.0)


def test_a_layer_is_held_against_the_product_of_its_own_shape(monkeypatch):
    peaks = Peaks(fp32_gflops=1e6, int8_gops=1e6, read_gb_s=1e6)
    monkeypatch.setattr("export.limits.product_ms", lambda *_shape, small: 3.0 if small else 5.0)
    work = Work((Layer(2, 10, 500, 500, small=True, convolves=True), Layer(1, 1, 2000, 2000, small=False)))
    assert work.shaped_ms(peaks) == pytest.approx(2 * 3.0 + 5.0)
    assert work.shaped_ms(peaks, convolves=True) == pytest.approx(6.0)
    assert work.limit_ms(peaks) < 0.1


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
    assert Timing.of(cpu * 1.1, cpu).judged_p99_ms == pytest.approx(2.2 * 1.1, rel=0.01)
    stretched = cpu.copy()
    stretched[-3:] = 30.0
    assert Timing.of(stretched, cpu).judged_p99_ms == pytest.approx(2.2, rel=0.01)


def test_the_page_says_which_speed_claim_holds_and_how_far_the_limit_is_missed(report):
    page = json.loads((report / "benchmark.json").read_text())
    row = {"files": ["x.onnx"], "cpu_p50_ms": 12.0, "limit_ms": 8.0, "shaped_ms": 10.0, "convolutions_ms": 4.0}
    page["alexnet"] = {
        "trained": False,
        "peaks": page["peaks"],
        "passes_cpu_ms": 300.0,
        "operators_ms": {"QGemm": 6.0},
        "rows": [
            row | {"what": "released: models", "ratio": (0.005, 0.004, 0.006), "claim": 1 / 150},
            row | {"what": SHARED, "ratio": (0.05, 0.04, 0.06), "claim": 1 / 25},
        ],
    }
    write(page, report)
    text = (report / "benchmark.md").read_text()
    assert "of random weights (speed only)" in text
    assert "| 1/200 [1/167, 1/250] | 1/150: holds |" in text
    assert "| 1/20 [1/17, 1/25] | 1/25: does not hold |" in text
    assert "it takes 1.50 times the peak limit and 1.20 times the shape limit" in text


def test_half_an_export_of_the_paper_s_networks_is_named(tmp_path):
    (tmp_path / "direction.sequence.onnx").touch()
    with pytest.raises(ContractError, match=r"magnitude\.sequence\.onnx is missing; export the checkpoint again"):
        files(tmp_path)


def test_the_claims_are_those_of_the_design():
    assert {1 / share for share in CLAIMS.values()} == {150.0, 25.0}


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
