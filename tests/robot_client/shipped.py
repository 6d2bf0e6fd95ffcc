"""Defaults and bounds of a device's table of the configuration: a time may be short, but never zero."""

import pytest
from pydantic import ValidationError

from tests.kept import is_as_kept


def is_bounded_and_as_kept(test_file, settings, **least):
    """Times and forces are above zero, however small, and a port is one of 2^16; the rest stays at its default.

    ``least``: of a field that may not be as small.
    """
    kind, shipped = type(settings), settings.model_dump(mode="json")
    for name in shipped:
        if name.endswith("port"):
            good, bad = (0, 65_535), (-1, 65_536)
        elif (name.endswith("_s") and not name.endswith("_mm_s")) or name == "force_limit_n":
            smallest = least.get(name, 1e-3)
            good, bad = (smallest,), (0.0, 0.999 * least.get(name, 0.0))
        else:
            continue
        for value in good:
            assert getattr(kind(**{name: value}), name) == value
        for value in bad:
            with pytest.raises(ValidationError, match=name):
                kind(**{name: value})
    is_as_kept(test_file, f"shipped: {kind.__module__}", shipped)
