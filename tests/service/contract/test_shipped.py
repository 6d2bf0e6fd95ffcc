import runpy
from pathlib import Path

import pytest

from service.contract import shipped


@pytest.mark.parametrize("packages", ["lib/python3.11/site-packages", "."])
def test_the_networks_are_found_where_pip_installs_for_one_user_or_into_a_folder(packages, tmp_path, monkeypatch):
    """Neither is the place that Python itself knows: `pip install --user`, or where pip may not write, and --target."""
    installed = tmp_path / packages / "service" / "contract" / "shipped.py"
    installed.parent.mkdir(parents=True)
    installed.write_bytes(Path(shipped.__file__).read_bytes())
    network = tmp_path / "share" / "tactile-insertion" / "models" / "pressing" / "pair.step.onnx"
    network.parent.mkdir(parents=True)
    network.touch()
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    assert runpy.run_path(str(installed))["released_models"]() == network.parent
