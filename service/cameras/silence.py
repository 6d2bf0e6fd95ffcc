"""Pictures whose stamps do not show their age, after a silence: they may have waited on the way for as long."""

from service.cameras.capture import CameraError

SILENT_S = 0.2  # at 10 mm/s, pictures that are late by less take less than the motion lease allows


def check_silence(last_ns: int | None, now_ns: int) -> None:
    """Raise CameraError if it is so long since ``last_ns``; with None, nothing has come before."""
    silent_s = 0.0 if last_ns is None else (now_ns - last_ns) / 1e9
    if silent_s > SILENT_S:
        raise CameraError(f"nothing was read for {silent_s:.1f} s: without stamps, what waited may be old")
