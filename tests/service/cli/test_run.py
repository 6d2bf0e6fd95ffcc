"""What `service run` says at its start, with nothing behind it."""

import logging
import threading
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import structlog

from service.cli import run
from tests.service.observability.test_log_lines import Stuck


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
    assert ("calibrate and commission again" in lines) == bool(why)
    assert why in lines


def test_a_warning_of_the_web_server_waits_for_no_reader_of_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is given in the event loop, and any client can cause it: the messages to the robot would wait."""
    out, settings = Stuck(), SimpleNamespace(log_json=False)
    monkeypatch.setattr("sys.stderr", out)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    for name in ("uvicorn", "uvicorn.error"):  # another test may have begun a server with the library's own logging
        monkeypatch.setattr(logging.getLogger(name), "handlers", [])
        monkeypatch.setattr(logging.getLogger(name), "propagate", True)
    warn: Any = logging.getLogger("uvicorn.error").warning
    with run.logging_to_standard_error(settings):  # type: ignore[arg-type]
        loop = threading.Thread(target=warn, args=["Invalid HTTP request received."], daemon=True)
        loop.start()
        loop.join(5)
        waited = loop.is_alive()
        out.reads.set()
    assert not waited
    assert out.getvalue() == "Invalid HTTP request received.\n"
    assert logging.getLogger().handlers == []


def test_a_clients_text_reaches_the_logs_terminal_as_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a reason to give up, or what a camera answers: it must not clear the screen, nor write over other lines."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    with run.logging_to_standard_error(SimpleNamespace(log_json=False)):  # type: ignore[arg-type]
        structlog.get_logger().warning("abort", reason="\x1b[2J\x1b]0;owned\x07inserted\x9b1A\u202e")
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    assert "\\x1b[2J\\x1b]0;owned\\x07inserted" in line
