"""A clock that advances only on request, in place of a module's ``time``."""

from types import ModuleType

import pytest


class Clock:
    """Stands still at ``now_s``."""

    now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s


def stopped_clock(monkeypatch: pytest.MonkeyPatch, *modules: ModuleType) -> Clock:
    """One clock for all these modules."""
    clock = Clock()
    for module in modules:
        monkeypatch.setattr(module, "time", clock)
    return clock
