"""Access control: bearer tokens with roles, and the origin of browsers."""

import hmac
from typing import Annotated, Any, Literal

from fastapi import Depends, HTTPException, Request, Security, WebSocket
from fastapi.security import HTTPBearer
from pydantic import SecretStr
from starlette.requests import HTTPConnection

from service.contract.token import keep_token
from service.settings import Settings

Role = Literal["watch", "drive", "admin"]
_RANK: dict[Role, int] = {"watch": 0, "drive": 1, "admin": 2}
FORBIDDEN_CLOSE = 4403
TOKEN = HTTPBearer(
    auto_error=False,
    scheme_name="token",
    description="The token's role is watch, drive or admin; each may do what those before it may. "
    "On the service's own machine watching needs none, unless --token-watch is given.",
)
CROSS_SITE, TOP_LEVEL = "cross-site", "navigate"


class Access:
    """Checks requests against the configured tokens, and against its own token if none is set for `admin`.

    A token comes as ``Authorization: Bearer TOKEN`` or, for browsers' WebSockets and images, ``?token=TOKEN``. Without
    a token, a client on this machine may watch, unless watching has its own token. Raises TokenError if the token in
    the state folder cannot be stored.
    """

    def __init__(self, settings: Settings) -> None:
        given: dict[Role, SecretStr | None] = {
            "watch": settings.token_watch,
            "drive": settings.token_drive,
            "admin": settings.token_admin,
        }
        self._tokens = [(role, token.get_secret_value()) for role, token in given.items() if token is not None]
        self.token_file = None
        if settings.token_admin is None:
            token, self.token_file = keep_token(settings.state)
            self._tokens.append(("admin", token))
        self._unnamed: Role | None = "watch" if settings.is_loopback and settings.token_watch is None else None
        self._origins = set(settings.allowed_origins)

    def role(self, connection: HTTPConnection) -> Role | None:
        """The highest role of a request's token, or the role that needs none; None for a wrong token."""
        if not (offered := offered_by(connection)):
            return self._unnamed
        held = [role for role, token in self._tokens if hmac.compare_digest(offered.encode(), token.encode())]
        return max(held, key=_RANK.__getitem__, default=None)

    def allows(self, connection: HTTPConnection, needed: Role) -> bool:
        role = self.role(connection)
        return role is not None and _RANK[role] >= _RANK[needed]

    def same_origin(self, connection: HTTPConnection) -> bool:
        """Whether a browser's page is ours or allowed; other clients send no Origin.

        A foreign page that embeds a picture sends none either, but is marked as another site.
        """
        headers = connection.headers
        origin = headers.get("origin")
        if origin is None:
            embedded = headers.get("sec-fetch-site") == CROSS_SITE and headers.get("sec-fetch-mode") != TOP_LEVEL
            return not embedded
        return origin.partition("://")[2] == headers.get("host") or origin.lower() in self._origins

    async def admit(self, socket: WebSocket, needed: Role) -> bool:
        """Close a WebSocket without access; True if it has access."""
        if self.allows(socket, needed) and self.same_origin(socket):
            return True
        await socket.close(FORBIDDEN_CLOSE)
        return False

    def check(self, request: HTTPConnection, needed: Role) -> None:
        """Raise HTTPException 401 or 403 unless a request may act in a role."""
        if not self.same_origin(request):
            raise HTTPException(403, "this page's origin is not allowed; see --allowed-origins")
        role = self.role(request)
        if role is None or (role == self._unnamed and _RANK[role] < _RANK[needed]):
            where = "; the service names the token's file at its start" if self.token_file else ""
            what = "this token is unknown" if offered_by(request) else "a bearer token is needed"
            raise HTTPException(401, what + where, {"WWW-Authenticate": "Bearer"})
        if _RANK[role] < _RANK[needed]:
            raise HTTPException(403, f"this token does not give the role {needed}")

    def require(self, needed: Role) -> Any:
        """A FastAPI dependency that refuses with 401 or 403; the description of its route names the role."""
        described = Security(TOKEN, scopes=[needed])

        async def check(request: Request, _: Annotated[Any, described]) -> None:  # async, or each waits for a thread
            self.check(request, needed)

        return Depends(check)


def offered_by(connection: HTTPConnection) -> str:
    """The token that a request carries, "" if none."""
    scheme, _, value = connection.headers.get("authorization", "").partition(" ")
    return value.strip() if scheme.lower() == "bearer" else connection.query_params.get("token", "")
