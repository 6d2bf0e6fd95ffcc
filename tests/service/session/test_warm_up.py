import numpy as np
import pytest

from service.contract import ContractError, TactileFrame, wire
from service.decision.models import ModelSet
from service.session.factory import make_session
from service.session.state_machine import InsertionSession
from service.session.warm_up import warm_up
from tests.service import drawn


@pytest.fixture
def session(models: ModelSet) -> InsertionSession:
    return make_session(models, drawn.calibration())


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> list[wire.ServiceMessage]:
    heard: list[wire.ServiceMessage] = []
    monkeypatch.setattr("service.session.warm_up._serialise", heard.append)
    return heard


def moves(messages: list[wire.ServiceMessage]) -> list[str]:
    """The first word of each controller's reason for its move."""
    return [message.detail.partition(" ")[0] for message in messages if isinstance(message, wire.Fault)]


def test_a_rehearsal_plays_an_attempt_to_its_answer_and_every_controller(
    session: InsertionSession, messages: list[wire.ServiceMessage]
) -> None:
    pair = drawn.pair(0)
    warm_up(session, [pair.right, pair.left])
    kinds = [message.type for message in messages]
    assert kinds[:2] == ["hello", "armed"]
    assert kinds.count("correction") == 1, [message for message in messages if message.type == "no_decision"]
    assert moves([message for message in messages if message.type == "fault"]) == ["class", "belief"]


def test_without_cameras_networks_and_controllers_are_rehearsed_all_the_same(
    session: InsertionSession, messages: list[wire.ServiceMessage]
) -> None:
    warm_up(session, [])
    assert moves(messages) == ["class", "belief"]
    assert session.insertion_id is None


def test_cameras_that_show_no_markers_do_not_keep_the_service_from_starting(
    session: InsertionSession, messages: list[wire.ServiceMessage]
) -> None:
    warm_up(session, [TactileFrame(f, 0, 0, np.zeros((320, 427, 3), np.uint8)) for f in ("left", "right")])
    assert "correction" not in [message.type for message in messages]
    assert moves(messages)[-2:] == ["class", "belief"], "after a stop of an attempt that was never armed"


def test_a_frame_of_the_wrong_size_is_named(session: InsertionSession) -> None:
    wrong = [TactileFrame(finger, 0, 0, np.zeros((480, 640, 3), np.uint8)) for finger in ("left", "right")]
    with pytest.raises(ContractError, match="frame is"):
        warm_up(session, wrong)
