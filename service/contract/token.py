"""The token that drives a service: made at its first start, and found automatically by the same user's clients."""

import contextlib
import ipaddress
import os
import secrets
from pathlib import Path
from urllib.parse import urlsplit

from service.contract.frames import ContractError

TOKEN_FILE = "token"  # noqa: S105 - a file's name
MIN_TOKEN_CHARACTERS = 16
HINT = "python -c 'import secrets; print(secrets.token_urlsafe())' makes one"


class TokenError(ContractError):
    """A token cannot be used, or its file cannot be read or written; the text names it and the expectation."""


def state_folder() -> Path:
    """Folder of the service's persistent state: ``TACTILE_STATE``, else the user's state folder (XDG).

    Raises TokenError for a user who has no home.
    """
    if given := os.environ.get("TACTILE_STATE"):
        return Path(given)
    try:
        return Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "tactile-insertion"
    except RuntimeError:
        raise TokenError("this user has no home for the state folder; name a folder in TACTILE_STATE") from None


def is_here(url: str) -> bool:
    """Whether a URL leads to this machine: its token must not go elsewhere."""
    return is_loopback(urlsplit(url).hostname or "")


def is_loopback(host: str) -> bool:
    """Whether a host is this machine, by its name or its address."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_token(token: str) -> str:
    """Return a token that is long enough to be a secret and fits into a header; raises TokenError."""
    if len(token) < MIN_TOKEN_CHARACTERS or not token.isascii() or not token.isprintable() or " " in token:
        given = f"{len(token)} characters" if token else "empty"
        raise TokenError(
            f"a token needs {MIN_TOKEN_CHARACTERS} or more visible ASCII characters, this one is {given}; {HINT}"
        )
    return token


def read_token(path: Path) -> str:
    """The token in a file; raises TokenError if it holds none, OSError if it cannot be read."""
    try:
        return check_token(path.read_text(encoding="utf-8").strip())
    except (TokenError, UnicodeDecodeError) as error:
        raise TokenError(f"token file {path}: {error}") from None


def keep_token(folder: Path) -> tuple[str, Path]:
    """The token of a state folder and its file, created if there is none; raises TokenError.

    The file appears atomically, readable by its owner alone. A file that others can read or own is refused.
    """
    path = folder / TOKEN_FILE
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _make(path)
        status = path.lstat()
        if status.st_mode & 0o170077 != 0o100000 or status.st_uid != os.geteuid():
            raise TokenError(f"{path} must be a file of this user that nobody else may read; remove it, or chmod 600")
        return read_token(path), path
    except OSError as error:
        raise TokenError(
            f"cannot keep a token in {folder} ({error.strerror}); name a folder of yours with --state"
        ) from None


def _make(path: Path) -> None:
    """Write a new token to a temporary file and link it into place, unless another process was first."""
    if os.path.lexists(path):
        return
    fresh = path.with_name(f".{path.name}-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as stream:
            stream.write(secrets.token_urlsafe(32) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)
