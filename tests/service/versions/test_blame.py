"""Which ends count against the version that decided: those that decisions can be responsible for."""

from pathlib import Path
from typing import Any

import pytest

from service.contract import wire
from service.decision.models import load_models
from service.session.state_machine import DEFAULT_LIMITS
from service.versions.versions import Versions
from tests.service import tiny_models


def failures(folder: Path, cause: Any, doubted: tuple[Any, ...]) -> int:
    """How many ended insertions count after one that ended so, with a promoted version."""
    released = tiny_models.write_models(folder / "released")
    versions = Versions(folder / "state", load_models(released), lambda *_: None)
    try:
        versions.give(tiny_models.write_models(folder / "shadow", git_commit="1" * 40))
        versions.promote()
        beside = versions.beside(versions.active, DEFAULT_LIMITS, "belief")
        assert beside is not None
        doubts = tuple(wire.Doubt(reason=reason, detail="so it is") for reason in doubted)
        outcome: Any = "not_confirmed" if cause == "not_confirmed" else "failed"
        end = wire.Finished(insertion_id="one", outcome=outcome, attempts=2, cause=cause, doubts=doubts)
        versions.learn(beside, end, "box", fresh=True, tried_n=0)
        previous = versions.state().previous
        assert previous is not None
        return previous.ended_n
    finally:
        versions.close()


@pytest.mark.parametrize(
    "doubted", [("neighbours",), ("not_seen",), ("width",), ("order",), ("depth",), ("neighbours", "not_seen")]
)
def test_full_depth_that_no_decision_makes_doubtful_is_no_evidence(tmp_path: Path, doubted: tuple[str, ...]) -> None:
    assert failures(tmp_path, "not_confirmed", doubted) == 0


@pytest.mark.parametrize(
    ("cause", "doubted"),
    [
        ("not_confirmed", ("moved_in_hand",)),
        ("not_confirmed", ("push",)),
        ("not_confirmed", ("not_held",)),
        ("not_confirmed", ("neighbours", "push")),
        ("not_confirmed", ()),
        ("attempts", ()),
        ("no_decision", ()),
    ],
)
def test_an_end_that_decisions_can_cause_is_a_failure(tmp_path: Path, cause: str, doubted: tuple[str, ...]) -> None:
    assert failures(tmp_path, cause, doubted) == 1
