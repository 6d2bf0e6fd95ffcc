import pytest

from service.contract import ContractError
from training.report import write_report
from training.train import train


def test_the_report_shows_every_split_and_the_pictures(config, source, tmp_path):
    train(config, source)
    page = write_report(config.folder, tmp_path / "docs", source).read_text()
    for row in ("| train/all |", "| validation/rectangle |", "| test/all |", "| validation/true fields |"):
        assert row in page
    assert (tmp_path / "docs" / "training.png").stat().st_size > 5000


def test_a_folder_that_is_no_run_is_named(tmp_path):
    with pytest.raises(ContractError, match="not the folder of a training run"):
        write_report(tmp_path, tmp_path)
