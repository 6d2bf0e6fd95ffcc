import re
import socket
from pathlib import Path

import pytest

from service import __main__ as entry
from service.settings import SettingsError, read_settings
from tests.service import drawn
from tests.service.mjpeg import FakeFinger

SECRET = "a-token-for-driving"
CAMERAS = ["--camera-left", "push:", "--camera-right", "push:"]


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("token", ["", "short", "fifteen-letters", "sixteen letters and spaces", "sixteen-lettérs-"])
@pytest.mark.parametrize("role", ["drive", "watch", "admin"])
def test_a_token_that_is_no_secret_is_refused_in_a_sentence(
    role: str, token: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(f"TACTILE_TOKEN_{role.upper()}", token)
    assert entry.main(["run", *CAMERAS, "--host", "0.0.0.0"]) == 2
    assert f"TACTILE_TOKEN_{role.upper()}: a token needs 16 or more" in one_line(capsys)


def test_a_token_is_one_roles_own() -> None:
    with pytest.raises(SettingsError, match="two roles have the same token"):
        read_settings([*CAMERAS, "--token-drive", SECRET, "--token-watch", SECRET])


@pytest.mark.parametrize("url", ["http://127.0.0.1:8081/stream.mjpg", "v4l2:0", "/dev/video0"])
def test_one_camera_cannot_be_both_fingers(url: str) -> None:
    with pytest.raises(SettingsError, match="each finger has its own camera"):
        read_settings(["--camera-left", url, "--camera-right", url])


def test_the_command_line_wins_over_environment_over_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = tmp_path / "c.toml"
    config.write_text('port = 1\ncontroller = "heuristic"\nmax_dx_mm = 5.0\n')
    monkeypatch.setenv("TACTILE_MAX_DX_MM", "6")
    monkeypatch.setenv("TACTILE_PORT", "2")
    for given in (["--config", str(config)], [f"--config={config}"]):
        settings = read_settings([*CAMERAS, *given, "--port", "3"])
        assert (settings.port, settings.max_dx_mm, settings.controller) == (3, 6.0, "heuristic")


@pytest.mark.parametrize("given", ["cell-pc,[2001:db8::1]", '["cell-pc", "[2001:db8::1]"]', "cell-pc, [2001:db8::1],"])
def test_several_names_are_set_by_a_variable_as_on_the_command_line(
    given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACTILE_ALLOWED_HOSTS", given)
    settings = read_settings(CAMERAS)
    assert settings.allowed_hosts == ("cell-pc", "[2001:db8::1]")
    monkeypatch.delenv("TACTILE_ALLOWED_HOSTS")
    assert read_settings([*CAMERAS, "--allowed-hosts", "cell-pc,[2001:db8::1]"]).hosts == settings.hosts


@pytest.mark.parametrize(
    "given", ["https://hmi.example/", "hmi.example", "*", "null", "http://x y", "https://a@hmi.example", "http://hmi:"]
)
def test_an_origin_that_no_browser_sends_is_refused_with_the_form_of_one(
    given: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TACTILE_ALLOWED_ORIGINS", f"https://good.example,{given}")
    form = "expected http://HOST:PORT or https://HOST, no more"
    with pytest.raises(SettingsError, match=re.escape(f"TACTILE_ALLOWED_ORIGINS: {given!r} is no origin; {form}")):
        read_settings(CAMERAS)


def test_origins_are_compared_as_browsers_write_them() -> None:
    """In small letters, and without the port that goes with the scheme."""
    given = "HTTPS://HMI.Example:443,http://hmi:80,https://hmi:80,http://[2001:DB8::1]:8080"
    allowed = read_settings([*CAMERAS, "--allowed-origins", given]).allowed_origins
    assert allowed == ("https://hmi.example", "http://hmi", "https://hmi:80", "http://[2001:db8::1]:8080")


def test_a_variable_that_is_left_empty_names_no_file(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SHADOW", "CALIBRATION"):
        monkeypatch.setenv(f"TACTILE_{name}", "")
    settings = read_settings(CAMERAS)
    assert (settings.shadow, settings.calibration) == (None, None)


@pytest.mark.parametrize("name", ["MODELS", "RECORDINGS", "STATE"])
def test_a_variable_that_is_left_empty_is_not_the_folder_that_the_service_runs_in(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(f"TACTILE_{name}", "")
    with pytest.raises(SettingsError, match=f"TACTILE_{name}: .*expected a folder, this is empty"):
        read_settings(CAMERAS)


def test_secrets_do_not_show() -> None:
    assert SECRET not in repr(read_settings([*CAMERAS, "--token-drive", SECRET]))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--camera-left", "push:"], "--camera-right: Field required"),
        ([*CAMERAS, "--controller", "magic"], "--controller"),
        ([*CAMERAS, "--bort", "1"], "--bort"),
        ([*CAMERAS, "--models", "nowhere", "--port", "0"], "no *.onnx model in nowhere"),
        ([*CAMERAS, "--config", "none.toml"], "none.toml"),
        ([*CAMERAS, "--max-frame-age-ms", "inf"], "--max-frame-age-ms"),
        ([*CAMERAS, "--client-timeout-s", "inf"], "--client-timeout-s"),
        ([*CAMERAS, "--tls-certificate", "none.pem", "--tls-key", "none.pem"], "--tls-certificate none.pem"),
    ],
)
def test_bad_input_is_one_line_and_exit_2(
    arguments: list[str], expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert entry.main(["run", *arguments]) == 2
    assert expected in one_line(capsys)


def test_a_busy_port_is_one_line_and_exit_2(models_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert entry.main(["run", *CAMERAS, "--models", str(models_folder), "--port", port]) == 2
    assert "pass another --port" in one_line(capsys)


def test_a_wrong_frame_size_is_named_and_exit_2(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fingers = FakeFinger("left"), FakeFinger("right")
    drawn.calibration().save(tmp_path / "calibration.toml")
    fingers[0].size = (640, 480)
    try:
        places = ["--models", str(models_folder), "--recordings", str(tmp_path / "r"), "--port", "0"]
        cameras = ["--camera-left", fingers[0].url, "--camera-right", fingers[1].url]
        code = entry.main(["run", *places, *cameras, "--calibration", str(tmp_path / "calibration.toml")])
    finally:
        for finger in fingers:
            finger.close()
    assert code == 2
    logged, error = capsys.readouterr().err.splitlines()
    assert "camera_size" in logged
    assert "left camera delivers 640 x 480 frames, expected 327 x 320 or 427 x 320" in error


def test_a_broken_calibration_is_one_line_and_exit_2(
    tmp_path: Path, models_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "c.toml").write_text("nonsense")
    arguments = [*CAMERAS, "--models", str(models_folder), "--port", "0", "--calibration", str(tmp_path / "c.toml")]
    assert entry.main(["run", *arguments]) == 2
    assert "c.toml" in one_line(capsys)


def test_an_unknown_name_is_refused_where_it_was_given_with_the_nearest_allowed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "cell.toml"
    config.write_text("controler = 'belief'\n")
    cases: list[tuple[list[str], dict[str, str], str]] = [
        (["--prot", "1"], {}, "unrecognized arguments: --prot 1; did you mean 'port'?"),
        (["--config", str(config)], {}, f"{config}: controler is not used; did you mean 'controller'?"),
        (
            [],
            {"TACTILE_CALIBRATON": "c.toml"},
            "environment: TACTILE_CALIBRATON is not used; did you mean 'TACTILE_CALIB",
        ),
        ([], {"tactile_port": "1"}, "environment: tactile_port is not used; did you mean 'TACTILE_PORT'?"),
        ([], {"tactile_prot": "1"}, "environment: tactile_prot is not used; did you mean 'TACTILE_PORT'?"),
        (
            ["--controller", "beleif"],
            {},
            "--controller: Input should be 'heuristic' or 'belief'; did you mean 'belief'?",
        ),
        ([], {"TACTILE_CONTROLLER": "beleif"}, "TACTILE_CONTROLLER: Input should be"),
    ]
    for arguments, variables, expected in cases:
        with monkeypatch.context() as environment:
            for name, value in variables.items():
                environment.setenv(name, value)
            with pytest.raises(SettingsError) as refused:
                read_settings([*CAMERAS, *arguments])
        assert expected in str(refused.value)
        assert "\n" not in str(refused.value)


def test_variables_of_others_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACTILE_INSERTION_RWS_PASSWORD", "x")
    monkeypatch.setenv("TACTILE_TRACEBACK", "1")
    assert read_settings(CAMERAS).port == 8000
