"""Progress goes to standard error, the first line of a log soon; standard output holds results only."""

import sys
from itertools import count
from types import SimpleNamespace

from simulation.data import progress as module


def test_lines_of_progress_go_to_standard_error(capsys, monkeypatch):
    clock = count(0.0, 4.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: next(clock)))  # not other threads' clock
    with module.progress("pokes", 100) as show:
        for done in (1, 2, 3):
            show(done)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert [line.split(",")[0] for line in shown.err.splitlines()] == ["2/100 pokes"]


def test_a_bar_goes_to_the_terminal_although_the_results_go_elsewhere(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with module.progress("pokes", 3) as show:
        show(3)
    shown = capsys.readouterr()
    assert shown.out == ""
    assert "3/3" in shown.err
