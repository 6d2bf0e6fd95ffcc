"""Robot Web Services as text: states as XHTML (the controller's default) or JSON, errors, passwords."""

import hashlib
import json
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any
from urllib.request import parse_http_list, parse_keqv_list

REALM = "validusers@robapi.abb"
JSON_TYPE = "application/json"
XHTML_TYPE = "application/xhtml+xml;v=1"
DONE = 294912  # the controller's own code of success


@dataclass(frozen=True, slots=True)
class State:
    """One resource in an answer: its type (``pnl-ctrlstate``), title, and fields: text, or a list of states within."""

    type: str
    title: str
    fields: Mapping[str, Any] = field(default_factory=dict)


def as_json(base: str, states: Sequence[State]) -> bytes:
    """``{"_links": ..., "_embedded": {"_state": [...]}}``."""
    return json.dumps({"_links": {"base": {"href": base}}, "_embedded": {"_state": _rows(states)}}).encode()


def as_xhtml(base: str, states: Sequence[State]) -> bytes:
    """The controller's XHTML: one list item per state, one span per field."""
    return (
        '<?xml version="1.0" encoding="utf-8"?><html xmlns="http://www.w3.org/1999/xhtml"><head><title>rws</title>'
        f'<base href="{escape(base)}"/></head><body><div class="state">{_list(states)}</div></body></html>'
    ).encode()


def _list(states: Sequence[State]) -> str:
    items = [
        f'<li class="{escape(state.type)}" title="{escape(state.title)}">'
        + "".join(
            _list(value) if isinstance(value, list) else f'<span class="{escape(name)}">{escape(str(value))}</span>'
            for name, value in state.fields.items()
        )
        + "</li>"
        for state in states
    ]
    return f"<ul>{''.join(items)}</ul>"


def _rows(states: Sequence[State]) -> list[dict[str, Any]]:
    return [
        {"_type": state.type, "_title": state.title}
        | {name: _rows(value) if isinstance(value, list) else value for name, value in state.fields.items()}
        for state in states
    ]


def error_body(code: int, message: str, *, wants_json: bool) -> bytes:
    """An error's code and text in either form."""
    if wants_json:
        return json.dumps({"_embedded": {"status": {"code": code, "msg": message}}}).encode()
    return as_xhtml("", [State("status", "error", {"code": code, "msg": message})])


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()  # RFC 7616's default, used by the IRC5


class Digest:
    """HTTP digest access (MD5, qop auth) for one user; nonces are remembered, replies must match one of them."""

    def __init__(self, user: str, password: str) -> None:
        self._secret = _md5(f"{user}:{REALM}:{password}")
        self._user = user
        self._nonces: dict[str, None] = {}

    def challenge(self) -> str:
        """A ``WWW-Authenticate`` value with a new nonce."""
        nonce = secrets.token_hex(16)
        self._nonces[nonce] = None
        while len(self._nonces) > 500:
            self._nonces.pop(next(iter(self._nonces)))
        return f'Digest realm="{REALM}", domain="/", qop="auth", nonce="{nonce}", opaque="rws", algorithm=MD5'

    def accepts(self, header: str | None, method: str) -> bool:
        """True if an ``Authorization`` header proves the password for one of our nonces."""
        if not header or not header.lower().startswith("digest "):
            return False
        try:
            sent = parse_keqv_list(parse_http_list(header[7:]))
        except (ValueError, IndexError):
            return False
        if sent.get("username") != self._user or sent.get("nonce") not in self._nonces:
            return False
        second = _md5(f"{method}:{sent.get('uri', '')}")
        middle = [sent["nonce"]]
        if "qop" in sent:
            middle += [sent.get("nc", ""), sent.get("cnonce", ""), sent["qop"]]
        expected = _md5(":".join([self._secret, *middle, second]))
        return secrets.compare_digest(expected, sent.get("response", ""))
