"""A cell that is off is learnt; noise never makes a surer network."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from service.contract import ContractError, Sensor
from service.contract.toml import toml_text
from tests.training.conftest import PRESSING, tiny
from tests.training.data.test_episodes import recorded
from tests.training.data.test_pressed import down
from training.adapt.adapt import adapt, compare, hold_out, report
from training.adapt.stages import calibrated
from training.data.episodes import PROBE, WORK, read_episodes
from training.data.labels import class_of
from training.fit.checkpoint import Checkpoint
from training.fit.train import train
from training.metrics.figures import Predictions, Scales


def compared(start, samples, *stages):
    return compare(start, samples, hold_out(start, samples, stages, 0), 0)


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """A network trained on 150 attempts of another gel."""
    folder = tmp_path_factory.mktemp("release")
    config = tiny(folder, folder)
    config = config.model_copy(
        update={
            "network": PRESSING,
            "trunk": config.trunk.model_copy(update={"epochs": 8, "learning_rate": 5e-3}),
        }
    )
    checkpoint = train(config, down(150))
    path = folder / "checkpoint.pt"
    checkpoint.save(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("stages", [("calibration", "gain"), ("calibration", "gain", "all")])
def test_work_of_a_cell_that_is_off_makes_a_network_that_knows_how_much_it_errs(release, tmp_path, stages):
    """Its errors are drawn by the release, so they shrink less than the cell is off (decision 164)."""
    comparison = adapt(recorded(tmp_path / "runs", 80, off_mm=6.0, work=True), release, tmp_path / "out", stages=stages)
    assert comparison.accepted, comparison.text()
    before, after = comparison.figures["released"], comparison.figures[comparison.best]
    assert comparison.figures["gain"]["mae_x_mm"] < 0.8 * before["mae_x_mm"], "accepted or not"
    assert after["mae_x_mm"] <= before["mae_x_mm"]
    assert before["coverage90_x"] < 0.7, "otherwise this tests nothing"
    assert after["coverage90_x"] > 0.8
    made = Checkpoint.load(tmp_path / "out" / "checkpoint.pt")
    assert made.run["adapted"]["stage"] == comparison.best
    assert made.run["adapted"]["cells"] == {"not stated": 80}
    assert made.figures["validation/all"] == after, "not those of the release"
    assert made.as_trained == Checkpoint.load(release).figures["validation/all"]
    assert made.figures["joint/validation/all"]["mae_x_mm"] < 1.05 * before["mae_x_mm"]
    with pytest.raises(ContractError, match="was adapted to 80 of these recordings"):
        adapt(tmp_path / "runs", tmp_path / "out" / "checkpoint.pt", tmp_path / "again")
    assert made.weights_sha256() != Checkpoint.load(release).weights_sha256() or comparison.best == "calibration"
    fresh = read_episodes(recorded(tmp_path / "fresh", 40, off_mm=6.0, seed=1, work=True), made.sensor)
    again, was = (compared(one, fresh).figures["released"] for one in (made, Checkpoint.load(release)))
    assert again["mae_x_mm"] <= was["mae_x_mm"]
    assert again["coverage90_x"] > max(0.8, was["coverage90_x"])


def test_presses_around_a_cell_teach_what_few_probes_only_confirm(release, tmp_path):
    """Errors outside the probes are learnt from a simulator of a similar cell; probes evaluate and calibrate it."""
    start, sensor = Checkpoint.load(release), Sensor.load()
    presses = read_episodes(recorded(tmp_path / "presses", 80, seed=5), sensor)
    probes = read_episodes(recorded(tmp_path / "probes", 30, seed=6), sensor)
    comparison = compare(start, probes, hold_out(start, probes, ("around",), 0, presses), 0)
    assert comparison.best == "around", comparison.text()
    assert comparison.accepted, comparison.text()
    before, after = comparison.figures["released"], comparison.figures["around"]
    assert after["mae_x_mm"] < 0.8 * before["mae_x_mm"]


def test_presses_that_are_like_no_cell_are_not_taken(release, tmp_path):
    start, sensor = Checkpoint.load(release), Sensor.load()
    presses = read_episodes(recorded(tmp_path / "presses", 40, seed=5, stated_right=False), sensor)
    probes = read_episodes(recorded(tmp_path / "probes", 30, seed=6), sensor)
    comparison = compare(start, probes, hold_out(start, probes, ("around",), 0, presses), 0)
    assert not comparison.accepted, comparison.text()


def test_a_tool_that_is_off_is_told_and_not_learnt(release, tmp_path):
    """A network that learnt it would steer every part beside the gap."""
    comparisons = {
        off_mm: adapt(recorded(tmp_path / f"{off_mm}", 60, off_mm=off_mm), release, tmp_path / "out", stages=("gain",))
        for off_mm in (0.0, 3.0)
    }
    straight, off = comparisons[0.0], comparisons[3.0]
    assert off.gap.at[0] - straight.gap.at[0] == pytest.approx(3.0, abs=3.0 * off.gap.sigma[0])
    assert off.gap.at[1] == pytest.approx(straight.gap.at[1], abs=3.0 * off.gap.sigma[1])
    was, now = (one.figures["released"]["mae_x_mm"] for one in (straight, off))
    assert now == pytest.approx(was, abs=0.4)


def test_probes_that_say_nothing_never_make_a_surer_network(release, tmp_path):
    """Errors unrelated to the input can at best teach the network how little it knows."""
    samples = read_episodes(recorded(tmp_path, 60, stated_right=False), Sensor.load())
    comparison = compared(Checkpoint.load(release), samples, "calibration", "gain")
    assert comparison.figures[comparison.best]["coverage90_x"] > comparison.figures["released"]["coverage90_x"]
    assert comparison.figures[comparison.best]["likelihood"] < comparison.figures["released"]["likelihood"]
    assert "negative log likelihood" in comparison.text(), "`nll` of the figures is of the direction alone"


@pytest.mark.parametrize(
    ("stage", "probes_n", "surer"),
    [("gain", 60, True), ("gain", 0, False), ("gain", 19, False), ("calibration", 60, False)],
)
def test_only_a_fit_to_probes_makes_a_network_surer(stage, probes_n, surer):
    """An insertion by a network's own moves agrees with it, whatever its error was."""
    rng, count = np.random.default_rng(0), 60
    truth = rng.uniform(-12, 12, (count, 2))
    error = truth + rng.normal(0.0, 0.2, truth.shape)
    logits = 9.0 * np.eye(9)[class_of(truth.astype(np.float32))]
    predictions = Predictions(
        logits, error, np.zeros((count, 2)), truth, np.where(np.arange(count) < probes_n, PROBE, WORK)
    )
    before = Scales(1.2, 1.1, 1.0)
    after = calibrated(stage, before, predictions)
    for name in ("temperature", "sigma_x", "sigma_theta"):
        assert (getattr(after, name) < getattr(before, name)) == surer
    wrong = replace(predictions, error=truth + rng.normal(0.0, 3.0, truth.shape))
    wider = calibrated(stage, before, wrong)
    assert min(wider.sigma_x, wider.sigma_theta) > 2.0


def test_a_cell_that_is_as_released_keeps_the_release_or_a_likelier_one(release, tmp_path):
    comparison = adapt(
        recorded(tmp_path / "runs", 40, seed=3), release, tmp_path / "out", stages=("calibration", "gain")
    )
    likelihoods = [comparison.figures[stage]["likelihood"] for stage in ("released", comparison.best)]
    assert likelihoods[1] <= likelihoods[0]
    assert comparison.accepted == (not comparison.objections) == (tmp_path / "out" / "checkpoint.pt").exists()


def test_too_few_probes_leave_the_release_and_none_are_an_error(release, tmp_path):
    few = adapt(recorded(tmp_path / "few", 7), release, tmp_path / "out")
    assert not few.accepted
    assert few.text().splitlines()[-1].endswith("7 fixtures, expected 20 of 5 at least; probe more")
    assert "held out" not in few.text(), "no figure is shown"
    with pytest.raises(ContractError, match="expected"):
        adapt(recorded(tmp_path / "none", 0), release, tmp_path / "out")


def test_the_text_names_what_was_compared_on_and_which_recordings_are_there(release, tmp_path):
    root, record = recorded(tmp_path / "cell", 24), tmp_path / "commissioning.toml"
    probes = [{"insertion_id": f"{index:04d}"} for index in range(4, 30)]
    record.write_text(toml_text({"named": [], "signs": [], "probes": probes}))
    for path in root.glob("001*/summary.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "simulated": True}))
    recorded(root, 30, seed=1, work=True, first=24)
    made = adapt(root, release, tmp_path / "out", record=record, stages=("gain",))
    assert made.known_of == {"probe": 20}
    printed = made.text()
    assert "20 first attempts of 20 fixtures (20 of probe), every" in printed
    assert f"\n20 of 26 listed insertions are in {root}\n" in printed
    assert "\nrecordings: 10 of a simulated cell, 40 do not say\n" in printed
    plain = json.loads(json.dumps(report(made)))
    assert (plain["known_of"], plain["listed"]["present_n"], plain["cells"]["simulated"]) == ({"probe": 20}, 20, 10)
    shutil.rmtree(root / "0010")
    few = adapt(root, release, tmp_path / "out", record=record, stages=("gain",))
    assert "49 first attempts of 49 fixtures (19 of probe and 30 of work), every" in few.text()


def test_a_checkpoint_of_an_earlier_run_does_not_pass_for_one_that_was_not_accepted(release, tmp_path):
    earlier, probes = tmp_path / "checkpoint.pt", recorded(tmp_path / "few", 7)
    earlier.write_bytes(release.read_bytes())
    with pytest.raises(ContractError, match="holds the release, which the adapted checkpoint would replace"):
        adapt(probes, earlier, tmp_path)
    assert earlier.read_bytes() == release.read_bytes()
    assert not adapt(probes, release, tmp_path).accepted
    assert sorted(path.name for path in tmp_path.glob("*.pt")) == ["earlier.pt"]


def test_a_network_that_does_not_say_what_it_was_adapted_to_is_refused(release, tmp_path):
    start = Checkpoint.load(release)
    replace(start, run={**start.run, "adapted": {"stage": "all"}}).save(tmp_path / "early.pt")
    with pytest.raises(ContractError, match=r"early\.pt was adapted by an earlier version.*adapt the release"):
        adapt(recorded(tmp_path / "runs", 5), tmp_path / "early.pt", tmp_path / "out")


def test_a_network_of_frames_is_refused(release, tmp_path):
    other = replace(Checkpoint.load(release), pressing=None)
    other.save(tmp_path / "frames.pt")
    with pytest.raises(ContractError, match="reads steps of depth"):
        adapt(recorded(tmp_path / "runs", 30), tmp_path / "frames.pt", tmp_path / "out")
