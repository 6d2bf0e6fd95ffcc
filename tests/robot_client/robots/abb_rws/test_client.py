"""The backup stop ends in words, whatever the controller answers."""

import asyncio

import httpx
import pytest

from robot_client.robots.abb_rws.client import RwsClient, RwsError
from robot_client.robots.abb_rws.settings import RwsSettings


@pytest.mark.parametrize("challenge", ["algorithm=SHA3, qop=auth", "algorithm=MD5, qop=auth-int", "qop=banana"])
def test_a_stop_that_cannot_even_be_asked_for_is_not_confirmed_in_words(challenge):
    def answer(_request):
        return httpx.Response(401, headers={"WWW-Authenticate": f'Digest realm="r", nonce="n", {challenge}'})

    async def story():
        client = RwsClient(RwsSettings(stop_timeout_s=0.05, poll_s=0.01))
        await client._client.aclose()
        transport, auth = httpx.MockTransport(answer), httpx.DigestAuth("user", "password")
        client._client = httpx.AsyncClient(transport=transport, auth=auth, base_url="http://127.0.0.1")
        outcome = await client.stop_program()
        with pytest.raises(RwsError, match="GET /rw/panel/opmode"):
            await client.status()
        await client.close()
        return outcome

    assert "STOP NOT CONFIRMED" in asyncio.run(story())
