"""Protection of the local web server: requires a token, and rejects requests from other sites.

Pages of other sites can send requests to this machine: through a name for it (DNS rebinding), as a
form, as a picture. Therefore the host, the origin and the browser's site header are checked first.
Everything except the first address needs a cookie that scripts cannot read. The host must be a
known name of this machine, or the address that the connection used; names of other owners do not
match.
"""

from __future__ import annotations

import base64
import hashlib
import secrets
from typing import TYPE_CHECKING, Final

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, PlainTextResponse, RedirectResponse, Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'nonce-{nonce}';"
    " style-src-attr 'unsafe-inline'; img-src 'self' blob: data:; connect-src 'self'; font-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'; require-trusted-types-for 'script'"
)
"""Content security policy of the page. Styles of the editor need the nonce; the browser itself sets some
attributes."""

_AGAIN: Final = 'if (location.search !== "?again") location.replace("/?again" + location.hash);'
"""Page that loads itself again, because browsers send no cookie for a link on a page of another site."""

_FIRST_PAGE: Final = f"""<!doctype html><html lang="en"><meta charset="utf-8"><title>sgstore</title>
<p>This page needs the address that 'sgstore serve' printed, with its token.
Open that address once in this browser; then links to the page work.</p><script>{_AGAIN}</script></html>
"""

_FIRST_POLICY: Final = (
    "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; script-src 'sha256-"
    f"{base64.b64encode(hashlib.sha256(_AGAIN.encode()).digest()).decode()}'"
)

_HEADERS: Final = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
"""HTTP headers of all responses, unless the application sets them itself."""


class Guard:
    """ASGI application that forwards a request only with a valid token, host and origin.

    Parameters
    ----------
    app : ASGIApp
    token : str
    hosts : tuple of str
        Permitted hosts, with ports.
    cookie : str
        Name of the cookie.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: tuple[str, ...], cookie: str) -> None:
        self._app, self._token, self._hosts, self._cookie = app, token, hosts, cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward a request to the protected application, or reject it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        nonce = secrets.token_urlsafe(16)
        scope.setdefault("state", {})["nonce"] = nonce

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("content-security-policy", POLICY.format(nonce=nonce))
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        answer = self._refusal(scope) if scope["type"] == "http" else Response(status_code=403)
        await (answer or self._app)(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        """Return a response that rejects the request or sets the login cookie.

        ``None`` means that the request may pass.
        """
        connection = HTTPConnection(scope)
        headers = connection.headers
        host = headers.get("host", "")
        name, port = scope.get("server") or ("", 0)
        if host not in {*self._hosts, host_of(name, port)}:
            return PlainTextResponse("wrong host", 403)
        if headers.get("origin", f"http://{host}") != f"http://{host}":
            return PlainTextResponse("wrong origin", 403)
        is_first_page = scope["method"] == "GET" and scope["path"] == "/"
        site = headers.get("sec-fetch-site")
        if site not in {None, "same-origin"} and not is_first_page:
            return PlainTextResponse("wrong site", 403)
        token = connection.query_params.get("token")
        if is_first_page and token is not None:
            return self._log_in() if self._is_token(token) else _no_token()
        if not self._is_token(connection.cookies.get(self._cookie, "")):
            return _first_page() if is_first_page else _no_token()
        return RedirectResponse("/", 303) if is_first_page and scope["query_string"] else None

    def _is_token(self, text: str) -> bool:
        return secrets.compare_digest(text.encode(), self._token.encode())

    def _log_in(self) -> Response:
        response = RedirectResponse("/", 303)
        response.set_cookie(
            self._cookie, self._token, max_age=30 * 86_400, httponly=True, samesite="strict"
        )
        return response


def host_of(name: str, port: int | None) -> str:
    """Return a host and a port in the form of the HTTP header ``Host``; IPv6 addresses are in brackets."""
    return f"[{name}]:{port}" if ":" in name else f"{name}:{port}"


def _no_token() -> Response:
    return PlainTextResponse(
        "This page needs the address that 'sgstore serve' printed, with its token.", 403
    )


def _first_page() -> Response:
    return HTMLResponse(_FIRST_PAGE, 403, {"content-security-policy": _FIRST_POLICY})
