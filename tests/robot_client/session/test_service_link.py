"""Who listens for slip must not fall silent unheard."""

import asyncio

import pytest

from robot_client.insertion.events import Failure
from robot_client.session.service_link import ServiceLink, ServiceSettings
from tests.robot_client.insertion.stories import ID, armed, slip


class Said:
    """Stands for the connection: what the service says, one after the other."""

    def __init__(self, *messages):
        self.messages = [message.model_dump_json() for message in messages]

    def __aiter__(self):
        return self

    async def __anext__(self):
        if not self.messages:
            raise StopAsyncIteration
        return self.messages.pop(0)


def test_a_defect_of_ours_in_handling_a_message_is_a_failure_at_once_and_not_a_silence():
    events = []

    def post(event):
        events.append(event)
        if not isinstance(event, Failure):
            raise ZeroDivisionError("a defect")

    async def story():
        link = ServiceLink(ServiceSettings(), ID)
        link._connection, link._post = Said(armed(1), slip(1)), post
        with pytest.raises(ZeroDivisionError):
            await link._receive()

    asyncio.run(story())
    assert [type(event) for event in events[1:]] == [Failure]
    assert (events[1].source, events[1].code) == ("service", "internal")
    assert "ZeroDivisionError: a defect" in events[1].detail
