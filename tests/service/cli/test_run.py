"""What `service run` says at its start, with nothing behind it."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from service.cli import run


@pytest.mark.parametrize("why", ["left: another gel is not noticed", ""])
def test_a_calibration_that_tells_no_gel_from_another_is_named_at_the_start(
    why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("open_station", "log_events", "create_app", "warm", "use_few_arenas", "open_many_files"):
        monkeypatch.setattr(run, name, Mock())
    monkeypatch.setattr(run, "stop_searching_what_stays", Mock())
    monkeypatch.setattr(run, "web_server", Mock(return_value=SimpleNamespace(run=Mock())))
    monkeypatch.setattr(run, "untold", Mock(return_value=why))
    switch_s = run.sys.getswitchinterval()
    try:
        assert run.main(["--port", "0", "--camera-left", "push:", "--camera-right", "push:"]) == 0
    finally:
        run.sys.setswitchinterval(switch_s)
    lines = capsys.readouterr().err
    assert ("calibrate again" in lines) == bool(why)
    assert why in lines
