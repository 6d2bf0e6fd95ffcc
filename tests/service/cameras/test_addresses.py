"""Addresses of cameras: a password in one is shown to nobody, however it is written."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from service.cameras.capture import CameraError
from service.cameras.sources import open_source
from service.contract.text import without_secrets
from service.settings import Settings

AMBIGUOUS = [
    "http://admin:hunter/2word@10.0.0.5/stream.mjpg",
    "http://admin:12/hunter2@10.0.0.5/stream.mjpg",
    "http://admin:hunter?2word@10.0.0.5/stream.mjpg",
    "http://admin:hunter#2word@10.0.0.5/stream.mjpg",
    "http://admin:hunter/2@word@10.0.0.5/stream.mjpg",
    "http://admin:hunter[2]word@10.0.0.5/stream.mjpg",
    "http://admin:hunter\u21002word@10.0.0.5/stream.mjpg",
    "http://admin:hunter2word/stream.mjpg",
]
"""The password of each holds a character that ends the part of an address in which passwords stand."""
OTHERS = [
    "https://admin:hunter2@10.0.0.5/stream.mjpg?pwd=hunter2",
    "rtsp://admin:hunter2@10.0.0.5:554/live",
    "HTTP://admin:hunter2@10.0.0.5/stream.mjpg",
    "rtsp://admin:hunter/2@10.0.0.5:554/live",
    "admin:hunter/2@10.0.0.5/stream.mjpg",
]


@pytest.mark.parametrize("url", AMBIGUOUS)
def test_an_address_that_cannot_be_split_safely_is_refused_unshown(url: str) -> None:
    with pytest.raises(CameraError, match=r"camera 'http://\.\.\.'.*write / as %2F") as refused:
        open_source(url)
    assert not any(part in str(refused.value) for part in ("hunter", "2word", "admin", "10.0.0.5"))
    assert without_secrets(url) == "http://..."


@pytest.mark.parametrize("url", OTHERS)
def test_an_address_of_another_kind_is_refused_without_its_password(url: str) -> None:
    with pytest.raises(CameraError, match="expected http://HOST:PORT/PATH") as refused:
        open_source(url)
    assert not any(part in str(refused.value) for part in ("hunter", "admin"))


@pytest.mark.parametrize(
    "part", ["/v?user=a&pwd=hunter 2", "/v?pwd=hunter\t2", "/a b?pwd=hunter2", "/v?pwd=hunt\u00e4r2"]
)
def test_a_query_that_no_request_can_hold_is_refused_at_the_start_and_not_shown(part: str) -> None:
    with pytest.raises(CameraError, match="a space as %20") as refused:
        open_source(f"http://admin:hunter2@10.0.0.5{part}")
    assert "hunt" not in str(refused.value)


def test_what_stands_where_it_belongs_is_taken_and_shown_without_secrets() -> None:
    for url, shown in (
        ("http://admin:hunter%2F2@10.0.0.5:81/v.mjpg", "http://10.0.0.5:81/v.mjpg"),
        ("http://admin:hunter@2@10.0.0.5/v.mjpg?pwd=hunter%202", "http://10.0.0.5/v.mjpg?..."),
        ("http://[::1]:9/v", "http://[::1]:9/v"),
    ):
        assert open_source(url).name == shown
    for url in ("file:///recordings/a@b", "v4l2:0", "push:", "recordings/a@b"):
        assert without_secrets(url) == url


@pytest.mark.parametrize("url", [*AMBIGUOUS, *OTHERS[:-1]])
def test_no_recording_holds_the_password(url: str, tmp_path: Path) -> None:
    settings = Settings(models=tmp_path, camera_left=url, camera_right="push:", recordings=tmp_path)
    assert "hunter" not in settings.model_dump_json()


@pytest.mark.parametrize("url", AMBIGUOUS)
def test_one_camera_for_both_fingers_is_refused_without_its_password(url: str, tmp_path: Path) -> None:
    with pytest.raises(ValidationError) as refused:
        Settings(models=tmp_path, camera_left=url, camera_right=url, recordings=tmp_path)
    (error,) = refused.value.errors()
    assert "each finger has its own camera" in error["msg"]
    assert "hunter" not in error["msg"]
