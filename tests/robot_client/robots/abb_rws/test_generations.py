"""Both generations of Robot Web Services, over real sockets and TLS: the controller shows which one it speaks."""

import asyncio
import contextlib
from pathlib import Path

import httpx
import pytest
from pydantic import SecretStr, ValidationError

from robot_client.insertion.state import Phase
from robot_client.robots.abb_rws.client import RwsClient
from robot_client.robots.abb_rws.generation import RwsError, credentials
from robot_client.robots.abb_rws.rws1 import RWS1
from robot_client.robots.abb_rws.rws2 import RWS2
from robot_client.robots.abb_rws.settings import RwsSettings
from robot_client.settings import SettingsError, load_settings
from simulation.cell.emulators.net import HttpServer, bind_tcp
from tests.robot_client.live_cell import bench
from tests.robot_client.robots.abb_rws.certificates import self_made


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    return self_made(tmp_path_factory.mktemp("omnicore"))


@pytest.fixture(params=["1.0", "2.0"])
def omnicore(request, certificate):
    """None for a controller of RobotWare 6."""
    return certificate if request.param == "2.0" else None


@contextlib.asynccontextmanager
async def reached(changes=lambda _: {}, **options):
    """A client of the controller, its settings changed by ``changes`` of them, and the cell."""
    async with asyncio.timeout(110.0), bench(**options) as cell:
        rws = cell.settings.robot.rws
        client = RwsClient(rws.model_copy(update=changes(rws)))
        try:
            yield client, cell
        finally:
            await client.close()


async def test_the_controller_is_asked_and_its_program_started_and_stopped(omnicore):
    async with reached(omnicore=omnicore) as (client, cell):
        await client.start_program()
        assert cell.cabinet.running
        assert await client.generation() is (RWS2 if omnicore else RWS1)
        status = await client.status()
        assert (status.operating_mode, status.controller, status.execution) == ("AUTO", "motoron", "running")
        assert status.speed_ratio == "100"
        assert await client.stop_program() == "controller confirms: program stopped"


async def test_a_proxy_of_the_environment_never_comes_between_the_client_and_its_controller(omnicore, monkeypatch):
    for name in ("http_proxy", "https_proxy", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")  # nobody answers there
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    async with reached(omnicore=omnicore) as (client, _):
        assert (await client.status()).operating_mode == "AUTO"


async def test_every_start_is_from_main_and_continues_no_stopped_motion(omnicore):
    async with reached(omnicore=omnicore) as (client, cell):
        for _ in range(2):
            await client.start_program()
            await client.stop_program()
        programs = [entry.title for entry in cell.cabinet.log if entry.title.startswith("Program")]
        assert programs == 2 * ["Program started", "Program stopped"]


async def test_signals_are_read_and_switched_with_either_generation(omnicore):
    async with reached(omnicore=omnicore) as (client, _):
        assert not await client.read_signal("doSlipStop")
        await client.write_signal("doSlipStop", on=True)
        assert await client.read_signal("doSlipStop")


async def error_of(changes, **options):
    async with reached(changes, **options) as (client, _):
        with pytest.raises(RwsError) as refused:
            await client.status()
    return str(refused.value)


async def test_a_certificate_that_is_not_trusted_is_one_line_that_says_what_to_do(certificate):
    error = await error_of(lambda _: {"certificate": None}, omnicore=certificate)
    assert "certificate that is not trusted: set robot.rws.certificate" in error
    assert "\n" not in error


async def test_another_controllers_certificate_is_not_believed(certificate, tmp_path):
    other, _ = self_made(tmp_path, "somebody-else")
    assert "is not trusted" in await error_of(lambda _: {"certificate": Path(other)}, omnicore=certificate)


async def test_an_authoritys_certificate_is_believed_for_its_own_name_only(certificate):
    """The pinned file as an authority: the name in it is not the one that the controller is called by."""
    assert "is not trusted" in await error_of(
        lambda _: {"certificate": None, "ca": Path(certificate[0])}, omnicore=certificate
    )


async def test_http_to_a_controller_of_robotware_7_says_https(certificate):
    error = await error_of(
        lambda rws: {"url": rws.url.replace("https", "http"), "certificate": None}, omnicore=certificate
    )
    assert "RobotWare 7 (OmniCore) is reached by https://" in error


async def test_https_to_a_controller_of_robotware_6_says_http():
    error = await error_of(lambda rws: {"url": rws.url.replace("http", "https")})
    assert "RobotWare 6 (IRC5) is reached by http://" in error


async def test_a_wrong_password_is_refused_by_either(omnicore):
    assert "HTTP 401" in await error_of(lambda _: {"password": SecretStr("wrong")}, omnicore=omnicore)


async def test_what_is_no_controller_is_named(tmp_path):
    async def stranger(_scope, _receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body", "body": b""})

    server = HttpServer(stranger, bind_tcp(0, "stranger"))
    await server.start()
    client = RwsClient(RwsSettings(url=f"http://127.0.0.1:{server.port}", request_timeout_s=20.0))
    try:
        with pytest.raises(RwsError, match=r"neither .*RobotWare 6.* nor .*RobotWare 7.*HTTP 200"):
            await client.status()
    finally:
        await client.close()
        server.stop()


def test_the_password_never_goes_out_readable():
    with pytest.raises(RwsError, match=r"in the clear; set robot.rws.url to https://192.168.125.1"):
        credentials('Basic realm="r"', "http://192.168.125.1", "user", "password")
    assert isinstance(credentials('Basic realm="r"', "https://192.168.125.1", "user", "password"), httpx.BasicAuth)
    assert isinstance(credentials('Basic realm="r"', "http://127.0.0.1:8", "user", "password"), httpx.BasicAuth)
    assert isinstance(credentials('DIGEST realm="r"', "http://192.168.125.1", "user", "password"), httpx.DigestAuth)


def test_a_password_in_the_address_is_refused_and_not_shown():
    """httpx would send it with the first request, whatever the controller asks for."""
    with pytest.raises(SettingsError, match=r"these are robot.rws.user and robot.rws.password") as refused:
        load_settings(None, {"robot": {"rws": {"url": "http://admin:hunter2@192.168.125.1"}}})
    assert "hunter2" not in str(refused.value)


def test_a_certificate_that_cannot_be_read_is_refused_by_the_settings(tmp_path):
    (tmp_path / "no.pem").write_text("no certificate")
    with pytest.raises(ValidationError, match="expected a certificate in PEM"):
        RwsSettings(certificate=tmp_path / "no.pem")
    with pytest.raises(ValidationError, match="No such file"):
        RwsSettings(ca=tmp_path / "none.pem")


@pytest.mark.slow
async def test_an_insertion_runs_live_with_either_generation(omnicore):
    async with bench(omnicore=omnicore) as cell:
        state = await cell.insert()
        assert state.phase is Phase.INSERTED, state.reason
        assert not cell.cabinet.running


@pytest.mark.parametrize(
    ("challenge", "media", "generations"),
    [
        ("Basic", "text/html", [False, True]),
        ("Digest", "text/html", [True, False]),
        ("Digest", "application/hal+json;v=2.0", [False, True]),
        ("Bearer", "application/hal+json;v=2.0", [False, True]),
        (None, "application/hal+json;v=2.0", [False, False]),
        (None, "text/html", [False, False]),
    ],
)
def test_a_generation_shows_by_the_password_that_it_asks_for(challenge, media, generations):
    head = {"content-type": media} | ({} if challenge is None else {"www-authenticate": f'{challenge} realm="r"'})
    assert [one.answered(httpx.Response(401, headers=head)) for one in (RWS1, RWS2)] == generations
