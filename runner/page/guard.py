"""Who may see a page: whoever has its address, which holds a token that nobody can guess."""

from __future__ import annotations

import secrets
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocketClose

from runner.contract import Refused
from runner.graph.placement import Host

TOKEN_CHARACTERS = 16
"""Of one that somebody chooses, at least."""
_HEADERS = {  # unless an answer has its own
    b"content-security-policy": b"default-src 'self'; style-src 'self' 'unsafe-inline'; frame-ancestors 'none'; "
    b"base-uri 'none'; form-action 'none'",
    b"referrer-policy": b"no-referrer",
    b"x-content-type-options": b"nosniff",
    b"cross-origin-resource-policy": b"same-origin",
    b"cache-control": b"no-cache",
}


class Guard:
    """Lets through what comes to the page's own address from the page itself, with the token as first part of its path.

    A token in the path needs no cookie, which every server of this machine would be sent. Refused is what names another
    host (one that somebody else has made mean this machine), comes from another page, or has no token.
    """

    def __init__(self, app: ASGIApp, token: str, hosts: frozenset[str]) -> None:
        """``hosts`` are ``NAME:PORT`` as browsers call the page."""
        self._app = app
        self._token = token
        self._hosts = hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request, or one connection."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        reason = self._refused(scope)
        if not reason:
            root = f"{scope.get('root_path', '')}/{self._token}"
            await self._app({**scope, "root_path": root}, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await WebSocketClose(1008, reason)(scope, receive, send)
        else:
            await PlainTextResponse(f"{reason}\n", 403)(scope, receive, _with_headers(send))

    def _refused(self, scope: Scope) -> str:
        """Why this is refused; empty where it is not."""
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self._hosts:
            return f"Host {host!r}: this page is not there; valid: {', '.join(sorted(self._hosts))}"
        if origin is not None and urlsplit(origin).netloc != host:
            return f"Origin {origin!r}: another page may not speak to this one"
        token, slash, _ = scope["path"].removeprefix("/").partition("/")
        if not slash or not secrets.compare_digest(token.encode(), self._token.encode()):
            return "no or another token: open the whole address that `runner up --page` has printed"
        return ""


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = {name for name, _ in message["headers"]}
            message["headers"] += [header for header in _HEADERS.items() if header[0] not in own]
        await send(message)

    return sending


def new_token(address: str, chosen: str) -> str:
    """The token of a page at an address: ``chosen``, or one by chance. Raises Refused for a short one, and for none
    beyond loopback."""
    if chosen:
        if len(chosen) < TOKEN_CHARACTERS or not chosen.replace("-", "").replace("_", "").isalnum():
            raise Refused(f"RUNNER_PAGE_TOKEN: must be {TOKEN_CHARACTERS} or more letters, digits, - and _")
        return chosen
    if not Host("page", address).loopback:
        raise Refused(f"--address {address}: a page beyond this machine needs a token: set RUNNER_PAGE_TOKEN")
    return secrets.token_urlsafe(TOKEN_CHARACTERS)
