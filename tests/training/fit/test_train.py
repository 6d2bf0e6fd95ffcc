from dataclasses import replace

import pytest
import torch

from export.onnx.to_onnx import why_untrained
from service.contract import ContractError, Sensor
from service.contract.model_card import Expectations
from tests.full_disk import files_of_at_most
from tests.training.synthetic import SyntheticSource
from training.config import RunConfig, StageConfig, alone_in
from training.data.reading import load
from training.fit.checkpoint import Checkpoint
from training.fit.loop import Stage, fit
from training.fit.train import train
from training.networks.forms import SequenceForm, StepForm
from training.networks.settings import NetworkConfig


@pytest.mark.slow
def test_the_trunk_learns_a_learnable_motion(config):
    """On fields whose rotation and pressure follow the error, a short training must find both."""
    stage = StageConfig(epochs=25, batch=32, learning_rate=4e-3, patience=25)
    data = config.data.model_copy(update={"rendered_training": 0, "rendered_validation": 0, "rendered_test": 0})
    idle = StageConfig(epochs=0)
    network = NetworkConfig(trunk_width=8, feature_size=32, state_size=32)
    whole = config.model_copy(update={"data": data, "front": idle, "tune": idle, "trunk": stage, "network": network})
    checkpoint = train(whole, SyntheticSource(300))
    figures = checkpoint.figures["fields/validation/all"]
    assert figures["accuracy"] > 0.7
    assert figures["rmse_x_mm"] < 2
    assert not checkpoint.as_trained, "its eyes were never trained, and no picture was shown to it"


def test_a_killed_run_resumes_to_the_same_weights(trained, config, source, monkeypatch):
    from training.fit import loop

    kept, calls = loop._save, []

    def dies(*arguments):
        kept(*arguments)
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(loop, "_save", dies)
    with pytest.raises(KeyboardInterrupt):
        train(config, source)
    monkeypatch.undo()
    whole, resumed = trained[1], train(config, source)
    assert all(torch.allclose(whole.weights[name], resumed.weights[name], atol=1e-6) for name in whole.weights)


@pytest.mark.parametrize("limit", [{"patience": 1}, {"max_minutes": 1e-9}])
def test_a_stage_that_ended_early_is_not_trained_on_by_a_second_call(tmp_path, limit, capsys):
    network, epochs = torch.nn.Linear(1, 1), []

    def batches(_):
        epochs.append(1)
        yield torch.ones(1, 1)

    def play():
        stage = Stage(
            "toy",
            StageConfig(epochs=5, **limit),
            list(network.parameters()),
            batches,
            1,
            loss=lambda given: network(given).square().mean(),
            validate=lambda: {"score": float(len(epochs))},  # the first epoch stays the best
        )
        fit(network, stage, tmp_path, 0)

    play()
    done = len(epochs)
    assert 1 <= done < 5
    play()
    assert len(epochs) == done
    assert ("toy: ENDED EARLY after 1 of 5 epochs" in capsys.readouterr().out) == ("max_minutes" in limit)


def test_a_run_that_was_cut_by_the_clock_says_so_and_goes_on_with_more_minutes_to_the_same_weights(
    trained, config, source
):
    whole, kept = trained[1], config.folder / "checkpoint.pt"
    cut = {"max_minutes": 1e-9}
    short = {stage: getattr(config, stage).model_copy(update=cut) for stage in ("front", "trunk", "tune")}
    train(config.model_copy(update=short), source)
    assert Checkpoint.load(kept).run["epochs_trained"] == {"front": 1, "trunk": 1, "tune": 1}
    went_on = train(config, source)
    assert went_on.run["epochs_trained"] == whole.run["epochs_trained"] == {"front": 2, "trunk": 2, "tune": 2}
    assert all(torch.allclose(whole.weights[name], went_on.weights[name], atol=1e-6) for name in whole.weights)
    assert train(config, source).weights_sha256() == went_on.weights_sha256()


@pytest.mark.parametrize("lost", ["optimiser", "schedule", "minutes"])
def test_a_stage_does_not_go_on_from_half_of_its_state(tmp_path, lost):
    network = torch.nn.Linear(1, 1)
    stage = Stage(
        "toy",
        StageConfig(epochs=1),
        list(network.parameters()),
        lambda _: iter([torch.ones(1, 1)]),
        1,
        loss=lambda given: network(given).square().mean(),
        validate=lambda: {"score": 0.0},
    )
    fit(network, stage, tmp_path, 0)
    kept = torch.load(tmp_path / "toy.resume.pt", weights_only=True)
    torch.save({name: value for name, value in kept.items() if name != lost}, tmp_path / "toy.resume.pt")
    with pytest.raises(ContractError, match=r"toy\.resume\.pt holds another architecture"):
        fit(network, stage, tmp_path, 0)


def test_a_checkpoint_names_its_run_but_no_place_of_the_machine(trained):
    config, _ = trained
    run = Checkpoint.load(config.folder / "checkpoint.pt").run
    assert run["seed"] == config.seed
    assert run["trunk"]["learning_rate"] == config.trunk.learning_rate
    assert not [place for place in (config.runs, config.data.path, config.data.cache) if place in str(run)]


def test_a_run_folder_belongs_to_one_config(trained, source):
    config, _ = trained
    with pytest.raises(ContractError, match="another config; its seed is 0, not 1; expected a new name"):
        train(config.model_copy(update={"seed": 1}), source)
    longer = config.model_copy(update={"trunk": config.trunk.model_copy(update={"epochs": 9})})
    with pytest.raises(ContractError, match=r"its trunk\.epochs is 2, not 9; expected"):
        train(longer, source)


@pytest.fixture
def cheap(config):
    """A run that reads true fields alone."""
    data = config.data.model_copy(update={"rendered_training": 0, "rendered_validation": 0, "rendered_test": 0})
    return config.model_copy(update={"data": data} | dict.fromkeys(("front", "tune"), StageConfig(epochs=0)))


def test_a_finished_run_that_is_started_again_keeps_its_commit_and_the_creep_that_was_measured(cheap, source):
    path = cheap.folder / "checkpoint.pt"
    made = train(cheap, source)
    creep = Expectations(creep_mm=0.07)
    replace(made, git_commit="before", expectations=creep).save(path)
    again = train(cheap, source)
    assert (again.git_commit, again.expectations) == ("before", creep)
    weights = {name: value + 1.0 for name, value in made.weights.items()}
    replace(made, weights=weights, git_commit="before", expectations=creep).save(path)
    other = train(cheap, source)
    assert (other.git_commit, other.expectations) == (made.git_commit, made.expectations)


def test_two_runs_are_not_trained_in_one_folder(cheap, source):
    """Each would overwrite what the other resumes from."""
    cheap.folder.mkdir(parents=True)
    with alone_in(cheap.folder), pytest.raises(ContractError, match="another process is training there"):
        train(cheap, source)
    assert train(cheap, source).weights


def test_a_network_that_was_shown_no_picture_is_not_validated(cheap, source):
    """Its figures on true fields look right, and its front may never have been trained."""
    checkpoint = train(cheap, source)
    assert checkpoint.figures["fields/validation/all"]["trials"] > 0
    assert why_untrained(checkpoint) == "its directions were never validated"


def test_a_damaged_config_is_named(cheap, source):
    cheap.folder.mkdir(parents=True)
    (cheap.folder / "config.json").write_bytes(b"\xff")
    with pytest.raises(ContractError, match=r"config\.json is damaged"):
        train(cheap, source)


def test_a_stage_without_pictures_is_refused_before_another_has_trained(cheap, source):
    tuned = cheap.model_copy(update={"tune": StageConfig(epochs=1)})
    with pytest.raises(ContractError, match=r"stage tune needs rendered train trials; see data\.rendered"):
        train(tuned, source)
    assert not list(cheap.folder.glob("*.pt"))


def test_a_run_does_not_go_on_with_other_data(cheap, source):
    """Its finished stages would be kept, and the card would state data that no weight has seen."""
    train(cheap, source)
    before = (cheap.folder / "checkpoint.pt").read_bytes()
    with pytest.raises(ContractError, match="trained on other data"):
        train(cheap, SyntheticSource(source.count + 5))
    assert (cheap.folder / "checkpoint.pt").read_bytes() == before


def test_a_run_does_not_go_on_from_other_weights(cheap, source):
    start = cheap.folder / "checkpoint.pt"
    kept = train(cheap, source)
    begun = cheap.model_copy(update={"name": "second", "start_from": str(start)})
    train(begun, source)
    Checkpoint(**{**vars(kept), "git_commit": "later"}).save(start)
    train(begun, source)  # saved again, they are the same weights
    Checkpoint(**{**vars(kept), "weights": {name: 2 * value for name, value in kept.weights.items()}}).save(start)
    with pytest.raises(ContractError, match="from other weights"):
        train(begun, source)


def test_a_full_disk_is_named_leaves_no_part_of_a_file_and_the_run_goes_on_afterwards(cheap, source):
    kept, again = train(cheap, source), cheap.model_copy(update={"name": "again"})
    with files_of_at_most(500), pytest.raises(OSError, match="too large"):
        train(again, source)
    with files_of_at_most(20_000), pytest.raises(ContractError, match="cannot be written, is the disk full"):
        train(again, source)
    assert not list(again.folder.glob("*.tmp"))
    assert train(again, source).weights_sha256() == kept.weights_sha256()
    elsewhere = cheap.model_copy(update={"data": cheap.data.model_copy(update={"cache": str(cheap.folder / "cache")})})
    with files_of_at_most(20_000), pytest.raises(ContractError, match=r"npz cannot be written, is the disk full\?"):
        load(elsewhere.data, "markers", source)
    assert not list(cheap.folder.rglob("*.npz"))


def test_data_that_cannot_be_read_do_not_claim_a_run_folder(cheap, source, tmp_path):
    mistyped = cheap.model_copy(update={"data": cheap.data.model_copy(update={"path": str(tmp_path / "nowhere")})})
    with pytest.raises(ContractError, match="cannot read the dataset"):
        train(mistyped)
    with pytest.raises(ContractError, match="no collisions in its validation split; collect more"):
        train(cheap, SyntheticSource(5))
    assert train(cheap, source).weights


def test_a_checkpoint_returns_what_was_saved(trained):
    config, saved = trained
    loaded = Checkpoint.load(config.folder / "checkpoint.pt")
    assert loaded.figures == saved.figures
    assert loaded.scales == saved.scales
    network = loaded.build()
    frames = torch.randint(0, 256, (1, 8, 2, 320, 327, 3), dtype=torch.uint8)
    gap, height = torch.full((1, 1), 56.0), torch.full((1, 1), 30.0)
    with torch.no_grad():
        whole = SequenceForm(network, "direction")(frames, gap, height)[0]
        step, state = StepForm(network, "direction"), torch.zeros(1, network.state_size)
        for index in range(8):
            logits, state = step(frames[:, index], frames[:, 0], state, gap, height)
    assert torch.allclose(whole, logits, atol=1e-5)


def test_a_checkpoint_of_another_architecture_is_refused(trained):
    config, _ = trained
    loaded = Checkpoint.load(config.folder / "checkpoint.pt")
    other = Checkpoint(**{**vars(loaded), "network": NetworkConfig(front_width=12)})
    with pytest.raises(ContractError, match="another architecture"):
        other.build()
    with pytest.raises(ContractError, match=r"than compact; its state_size is 16, not 24$"):
        loaded.build(loaded.network.model_copy(update={"state_size": 24}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name = 'x'", "data"),
        ("name = 3", "name"),
        ("name = ", "not valid TOML"),
        ("name = 'x'\nspeed = 3\n[data]\npath='p'\n[front]\nepochs=1\n[trunk]\nepochs=1\n[tune]\nepochs=1", "speed"),
        ("name = 'x'\n[data]\npath='p'\n[front]\nepochs=-1\n[trunk]\nepochs=1\n[tune]\nepochs=1", "front.epochs"),
        ("name = 'x'\nseed = 4294967296\n[data]\npath='p'\n[trunk]\nepochs=1", "seed: expected a number >= 0 and <"),
        ("name = 'x'\n[data]\npath='p'\n[network]\nstate_size=10000\n[trunk]\nepochs=1", "state_size: .* <= 4096"),
        ("name = 'x'\n[data]\npath='p'\n[network]\nkind='pressing'\n[trunk]\nepochs=1", "affine_fit is false"),
        (
            "name = 'x'\n[data]\npath='p'\n[network]\nkind='markers'\n[trunk]\nepochs=1\n[tune]\nepochs=2",
            "train on pictures, which markers does not read",
        ),
    ],
)
def test_a_bad_config_is_named(tmp_path, text, message):
    path = tmp_path / "run.toml"
    path.write_text(text)
    with pytest.raises(ContractError, match=message):
        RunConfig.load(path)


def test_the_papers_network_is_not_trained_as_ours(config, source):
    with pytest.raises(ContractError, match="training recipe"):
        train(config.model_copy(update={"network": NetworkConfig(kind="alexnet_lstm")}), source)


def test_a_dataset_without_collisions_is_refused(config):
    source = SyntheticSource(10)
    for trial in source.trials:
        trial.outcome = "inserted"
    with pytest.raises(ContractError, match="none of the 10 trials"):
        train(config, source)


def test_network_stays_under_a_million_parameters():
    from training.networks import build

    count = sum(parameter.numel() for parameter in build(NetworkConfig(), 9, Sensor.load()).parameters())
    assert count < 1_000_000
