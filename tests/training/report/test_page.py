import pytest

from service.contract import ContractError
from training.fit.checkpoint import Checkpoint
from training.fit.train import train
from training.metrics.figures import Scales
from training.networks.settings import NetworkConfig
from training.report.page import recipe_part, write_report
from training.report.stress import stress


def test_the_report_shows_every_split_and_the_pictures(config, source, tmp_path):
    train(config, source)
    page = write_report(config.folder, tmp_path / "docs", source).read_text()
    for row in ("| train/all |", "| validation/rectangle |", "| test/all |", "| validation/true fields |"):
        assert row in page
    assert "instead of pictures" in page
    assert "other data now there" not in page
    assert (tmp_path / "docs" / "training.png").stat().st_size > 5000


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(ContractError, match="not the folder of a training run"):
        write_report(tmp_path, tmp_path)


def test_a_run_of_ours_does_not_stand_in_for_the_papers_recipe(tmp_path):
    Checkpoint("ours", NetworkConfig(), {}, Scales(), Scales(), {}, "0" * 64, "none").save(tmp_path / "checkpoint.pt")
    with pytest.raises(ContractError, match="holds a compact network, expected a run of `python -m training recipe`"):
        recipe_part(tmp_path, "0" * 64)


@pytest.mark.parametrize("trials", [0, -5])
def test_a_stress_on_no_trials_is_refused_by_name(tmp_path, trials):
    with pytest.raises(ContractError, match=f"--trials {trials}"):
        stress(tmp_path, trials)
