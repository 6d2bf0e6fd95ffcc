"""Which ends count against the version that decided: those that decisions can be responsible for."""

from pathlib import Path
from typing import Any

import pytest

from service.contract import wire
from service.decision.attempt import Attempt
from service.decision.models import load_models
from service.session.state_machine import DEFAULT_LIMITS
from service.versions.versions import Versions
from tests.service import tiny_models
from tests.service.decision.test_consistency import correction
from tests.service.session.driving import arm


def failures(folder: Path, cause: Any, doubted: tuple[Any, ...], undecided: tuple[Any, ...] = ()) -> int:
    """How many ended insertions count after one that ended so, with a promoted version.

    Its attempts were ``undecided`` for these reasons; in place of one, "correction" is an attempt that was decided.
    """
    released = tiny_models.write_models(folder / "released")
    versions = Versions(folder / "state", load_models(released), lambda *_: None)
    try:
        versions.give(tiny_models.write_models(folder / "shadow", git_commit="1" * 40))
        versions.promote()
        beside = versions.beside(versions.active, DEFAULT_LIMITS, "belief")
        assert beside is not None
        for reason in undecided:
            beside.decide(decided(reason))
        doubts = tuple(wire.Doubt(reason=reason, detail="so it is") for reason in doubted)
        outcome: Any = "not_confirmed" if cause == "not_confirmed" else "failed"
        end = wire.Finished(insertion_id="one", outcome=outcome, attempts=2, cause=cause, doubts=doubts)
        versions.learn(beside, end, "box", fresh=True, tried_n=0)
        previous = versions.state().previous
        assert previous is not None
        return previous.ended_n
    finally:
        versions.close()


def decided(reason: Any) -> Attempt:
    """An attempt without frames, answered by no decision for a reason or by "correction"; "late": of its networks."""
    attempt = Attempt(arm(), armed_ns=0, generation=1, fed=reason == "late")
    reason = "stale" if attempt.fed else reason
    if reason == "correction":
        attempt.decision = correction(here=(1.0, 1.0), sigma=(1.0, 1.0), move=(-1.0, -1.0))
    else:
        attempt.decision = wire.NoDecision(**attempt.named, reason=reason, detail="so it is")
    return attempt


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


@pytest.mark.parametrize(
    ("undecided", "counted"),
    [
        (("stale", "too_few_frames", "no_motion"), 0),
        (("out_of_distribution", "correction", "stale", "stale", "stale"), 0),
        (("stale", "out_of_distribution", "stale"), 1),
        (("non_finite",) * 3, 1),
        (("late",) * 3, 1),
        (("low_confidence",) * 3, 1),
    ],
)
def test_what_a_camera_leaves_undecided_is_no_evidence(
    tmp_path: Path, undecided: tuple[str, ...], counted: int
) -> None:
    assert failures(tmp_path, "no_decision", (), undecided) == counted
