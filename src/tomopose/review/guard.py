"""Who may ask: only pages of this server, on this machine, that know the token.

The address is the loopback alone, but every web page that is open on the machine can send requests there.  So

    Host     must name the loopback: a foreign name that resolves to it (rebinding) is refused.  The port is free, so
             that a forwarded one (ssh -L 9000:localhost:8000) works;
    Origin   where a browser states one it must be this server's own; Sec-Fetch-Site must not be another site;
    token    256 random bits at the head of every path, compared in constant time;
    body     at most BODY_BYTES.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from typing import Any
from urllib.parse import urlsplit

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Message, Receive, Send], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "::1")
BODY_BYTES = 65_536
SAFE_HEADERS: Mapping[str, str] = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}


def new_token() -> str:
    """256 random bits, as they go into an address."""
    return secrets.token_urlsafe(32)


def host_name(host: str) -> str:
    """The name of a Host header without its port; "" where it is not one."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def refusal(path: str, headers: Mapping[str, str], token: str) -> tuple[int, str] | None:
    """(status, why) where a request is refused; None where it may pass.  headers: by their names in small letters."""
    host = headers.get("host", "")
    if host_name(host) not in LOOPBACK:
        return 421, "this server answers on the loopback address alone"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return 403, "the request comes from another origin"
    if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
        return 403, "the request comes from another site"
    given = path.lstrip("/").split("/", 1)[0]
    if not hmac.compare_digest(given.encode(), token.encode()):
        return 403, "the address lacks the token that was printed when the review began"
    if not headers.get("content-length", "0").isdigit() or int(headers.get("content-length", "0")) > BODY_BYTES:
        return 413, "the request is too long"
    if "transfer-encoding" in headers:
        return 411, "the request states no length"
    return None


class Guard:
    """An ASGI application that refuses, strips the token from the path, and adds headers to every answer."""

    def __init__(self, app: App, token: str) -> None:
        self.app, self.token = app, token

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refused = refusal(scope["path"], headers, self.token)

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(k.encode(), v.encode()) for k, v in SAFE_HEADERS.items()]
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        if refused is not None:
            status, why = refused
            start = {"type": "http.response.start", "status": status, "headers": [(b"content-type", b"text/plain")]}
            await send_safely(start)
            await send_safely({"type": "http.response.body", "body": why.encode()})
            return
        rest = scope["path"].removeprefix(f"/{self.token}") or "/"
        await self.app({**scope, "path": rest, "raw_path": rest.encode()}, receive, send_safely)
