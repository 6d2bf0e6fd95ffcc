import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from export.bench.measure import Timing
from export.onnx.decisions import Decision
from export.onnx.golden import golden_frames
from export.onnx.model import open_model
from export.onnx.verify import decide
from export.quantise.quantise import store_fp16
from export.tradeoff import builds
from export.tradeoff import tradeoff as room
from export.tradeoff.candidates import Candidate, find_candidates
from export.tradeoff.points import (
    Point,
    closed_loop_trials,
    pareto,
    physics_points,
    tracker_points,
)
from export.tradeoff.report import default_network, draw, gains, tradeoff_page
from export.tradeoff.scores import Score, score
from export.tradeoff.tradeoff import agreements, choose, points_of
from service.contract import ContractError

DOCS = Path("docs")


@pytest.fixture(scope="module")
def models():
    """The released networks: opening them costs less than exporting tiny ones."""
    return Path("models/pictures")


def timing(ms):
    return Timing.of(np.full(50, ms), np.full(50, ms))


def point(name, better, cost):
    about = {
        "frames": 8,
        "network": "a",
        "input": "320 x 327 px",
        "mae_mm": (1.0, 0.9, 1.1),
        "mae_deg": (2.0, 1.9, 2.1),
    }
    return Point(name, better, better - 0.05, better + 0.05, cost, cost, cost, 10, None, about)


@pytest.fixture(scope="module")
def decisions(models):
    spec = open_model(models / "direction.step.onnx").card.frame
    truths = ((8.0, 0.0), (-8.0, 9.0))
    return [
        Decision(golden_frames(spec, 8, seed), 56.0, 30.0, np.array(truth, np.float32), "rectangle")
        for seed, truth in enumerate(truths)
    ]


@pytest.fixture(scope="module")
def table(models, decisions, tmp_path_factory):
    candidates = find_candidates([models, models.parent / "joint"])
    scores = score(candidates, decisions)
    empty = tmp_path_factory.mktemp("docs")
    networks = [entry for c in candidates for entry in points_of(c, timing(1.0), scores[c.sha256], empty)]
    return {
        "networks": networks,
        "slip": tracker_points(DOCS / "slip_report.json"),
        "physics": physics_points(DOCS / "accuracy.json"),
    }


def test_a_pair_and_a_joint_density_give_a_point_for_each_number_of_frames(table):
    assert [entry.about["frames"] for entry in table["networks"]] == [2, 4, 8] * 2
    assert [entry.cost_ms for entry in table["networks"]] == [2.0, 4.0, 8.0] * 2


def test_stopping_after_eight_frames_is_the_whole_decision(models, decisions):
    (pair,) = find_candidates([models])
    whole = decide(pair.models[0], decisions[0].frames[None])["logits"][0]
    assert pair.answers(decisions)[0][8].chosen == whole.argmax()


def test_nothing_is_scored_on_no_decision(models):
    with pytest.raises(ContractError, match="no decision"):
        score(find_candidates([models]), [])


def test_a_build_is_compared_by_the_commands_of_its_source(models, decisions, tmp_path):
    store_fp16(models.parent / "joint" / "joint.step.onnx", tmp_path / "joint.step.onnx")
    candidates = find_candidates([models.parent / "joint", tmp_path])
    (row,) = agreements(candidates, score(candidates, decisions))
    assert (row["decisions"], row["same_command"], row["sign_flips"]) == (2, 1.0, 0)


def test_one_page_and_one_figure_show_all_three_rooms(table, tmp_path):
    about = {
        "cpu": "a processor",
        "split": "validation",
        "data": "abc",
        "decisions": 2,
        "crowding": 1.1,
        "commit": "abcdef",
        "refused": ["models int8-static: far off"],
    }
    about["agreement"] = [{"name": "a network int8", "summary": "99 % of the commands"}]
    text = tradeoff_page(room.report_of(table, about))
    draw(table, tmp_path / "tradeoff.png")
    assert all(entry.name in text for points in table.values() for entry in points)
    assert (tmp_path / "tradeoff.png").stat().st_size > 10_000


def test_a_build_says_what_it_saves_and_whether_it_keeps_the_commands():
    costs = {"fp32": (1.0, 4.0), "int8 blocked": (0.5, 1.0), "int8 dynamic": (1.0, 1.5), "int8 static": (1.2, 4.1)}
    points = [point(name, 0.9, 8 * time_ms) for name, (time_ms, _) in costs.items()]
    for entry, (name, (time_ms, size_mb)) in zip(points, costs.items(), strict=True):
        entry.about.update(kind="pair", precision=name, step_cpu_ms=time_ms, size_mb=size_mb)
    kept = {"int8 blocked": 1.0, "int8 dynamic": 0.9, "int8 static": 1.0}
    rows = [{"name": f"a pair {name}", "same_command": share} for name, share in kept.items()]
    first, second, third = gains(rows, points)
    assert first == "- a pair int8 blocked takes 0.50 of fp32's time and 0.25 of its size: it saves time and space."
    assert second.endswith("it saves space, but keeps less than 99 % of the commands: it does not pay.")
    assert third.endswith("it saves nothing.")


def test_no_point_of_the_front_is_beaten():
    points = [point("slow", 0.9, 9), point("good", 0.9, 2), point("poor", 0.5, 3), point("fast", 0.7, 1)]
    assert [entry.name for entry in pareto(points)] == ["fast", "good"]


def test_the_default_cannot_be_told_from_the_best():
    assert default_network([point("a", 0.9, 9), point("b", 0.86, 2), point("c", 0.6, 1)]).name == "b"


def test_a_point_without_a_number_is_refused():
    with pytest.raises(ContractError, match="not finite"):
        point("bad", float("nan"), 1)


def test_mean_trials_of_a_closed_loop_are_pooled_by_insertions(tmp_path):
    row = {"controller": "belief", "training": True, "condition": "", "mean_trials_standard_error": 0.1}
    rows = [row | {"mean_trials": 2.0, "insertions": 30}, row | {"mean_trials": 4.0, "insertions": 10}]
    rows.append(row | {"mean_trials": 16.0, "insertions": 90, "training": False})
    path = tmp_path / "closed_loop.json"
    path.write_text(json.dumps({"summaries": rows, "setup": {"belief/a.onnx": hashlib.sha256(b"a").hexdigest()}}))
    mean, low, high = closed_loop_trials(path, "belief")
    assert mean == pytest.approx(2.5)
    assert low < mean < high
    assert closed_loop_trials(path, "joint") is None
    for name, content in (("a.onnx", b"a"), ("b.onnx", b"a")):
        (tmp_path / name).write_bytes(content)
    assert closed_loop_trials(path, "belief", [tmp_path / "a.onnx"]) is not None
    assert closed_loop_trials(path, "belief", [tmp_path / "b.onnx"]) is None


def test_mean_trials_belong_to_the_very_files_that_played_wherever_they_lie(models, tmp_path):
    (pair,) = find_candidates([models])
    together = Candidate(pair.name, "shared", models / "pair", pair.models[:1])
    row = {"controller": "paper", "training": True, "condition": "", "mean_trials": 2.0, "insertions": 30}
    setup = {f"paper/{model.file.name}": hashlib.sha256(model.file.read_bytes()).hexdigest() for model in pair.models}
    report = {"summaries": [row | {"mean_trials_standard_error": 0.1}], "setup": setup}
    (tmp_path / "closed_loop.json").write_text(json.dumps(report))
    for candidate in (pair, together):
        *_, last = points_of(candidate, timing(1.0), {8: Score([True], [1.0], [1.0])}, tmp_path)
        assert last.mean_trials[0] == 2.0
    report["setup"]["paper/magnitude.step.onnx"] = "0" * 64
    (tmp_path / "closed_loop.json").write_text(json.dumps(report))
    (point,) = points_of(pair, timing(1.0), {8: Score([True], [1.0], [1.0])}, tmp_path)
    assert point.mean_trials is None


def test_a_budget_names_the_best_network_that_keeps_it(models, table, tmp_path, monkeypatch):
    report = tmp_path / "tradeoff.json"
    report.write_text(json.dumps(room.report_of({"networks": table["networks"]}, {})))
    monkeypatch.setattr("export.tradeoff.candidates.Candidate.time_step", lambda self, _: timing(len(self.models)))
    assert "joint.step.onnx" in choose(1.5, report, 0.0)
    assert "right direction" in choose(50.0, report, 0.0)
    with pytest.raises(ContractError, match=r"no network keeps 0\.5 ms here; the fastest is"):
        choose(0.5, report, 0.0)
    with pytest.raises(ContractError, match="expected more than 0"):
        choose(float("nan"), report, 0.0)


def test_a_report_that_is_none_is_named(tmp_path):
    (tmp_path / "tradeoff.json").write_text("[]")
    with pytest.raises(ContractError, match=r"tradeoff\.json"):
        choose(5.0, tmp_path / "tradeoff.json", 0.0)


def test_a_killed_run_leaves_no_half_made_build(tmp_path, monkeypatch):
    """The next run would take it for finished: it is younger than its source."""
    source = tmp_path / "models" / "joint.step.onnx"
    source.parent.mkdir()
    source.write_bytes(Path("models/joint/joint.step.onnx").read_bytes())
    begun = []

    def killed(_, out, *__, **___):
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(b"half of a graph")
        begun.append(out)
        if out.parent.name == "fp16":
            raise KeyboardInterrupt
        return out

    monkeypatch.setattr(builds, "quantise", killed)
    monkeypatch.setattr(builds, "store_fp16", killed)
    monkeypatch.setattr(builds._Calibration, "decisions", [])
    with pytest.raises(KeyboardInterrupt):
        builds.make_builds([source.parent], tmp_path / "builds", "unused")
    assert begun[-1].parent.name == "fp16"
    assert not list(begun[-1].parent.iterdir())
