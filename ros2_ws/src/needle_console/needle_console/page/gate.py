"""Lets nobody to the page whom `access` does not: every request passes here, upgrades too."""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any, TypeAlias
from urllib.parse import parse_qs

from needle_console.access.access import Access

_Scope: TypeAlias = MutableMapping[str, Any]
_Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
_Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
_App: TypeAlias = Callable[[_Scope, _Receive, _Send], Awaitable[None]]

COOKIE = "needle_console"
_LOGIN = "/login"
_LONGEST_LOGIN = 1024
_PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Needle console</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>body{{font:16px sans-serif;max-width:24rem;margin:20vh auto;padding:0 1rem}}
input,button{{font:inherit;padding:.5rem;width:100%;box-sizing:border-box;margin:.4rem 0}}</style>
</head><body><h1>Needle console</h1><p>{words}</p><form method="post" action="/login">
<label>Token <input type="password" name="token" autofocus autocomplete="current-password"></label>
<button>Open</button></form></body></html>"""


class Gate:
    """An ASGI application around another.

    Parameters
    ----------
    app : callable
        What is behind the gate; kept as the attribute `app`.
    access : Access
        Who may come in.
    """

    def __init__(self, app: _App, access: Access) -> None:
        self.app = app
        self._access = access
        # In the browser in the token's place; it ends with the process.
        self._session = secrets.token_urlsafe(32)

    async def __call__(self, scope: _Scope, receive: _Receive, send: _Send) -> None:
        """Answer, or hand on, one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        send = _forbid_framing(send)
        why = self._why_not(scope)
        if why:
            await _refuse(scope, send, 403, why)
        elif not self._access.needs_token or self._knows(_header(scope, b"cookie")):
            await self.app(scope, receive, send)
        elif scope["type"] == "http" and scope["path"] == _LOGIN and scope["method"] == "POST":
            await self._log_in(receive, send)
        elif scope["type"] == "http" and scope["path"] == "/" and scope["method"] == "GET":
            await _answer(send, 200, _PAGE.format(words="Who runs the rig knows its token."))
        else:
            await _refuse(scope, send, 403, "not logged in")

    def _why_not(self, scope: _Scope) -> str:
        why = self._access.why_not_host(_header(scope, b"host"))
        origin = _header(scope, b"origin")
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if not why and (origin or changes):
            why = self._access.why_not_origin(origin)
        return why

    def _knows(self, cookies: str) -> bool:
        try:
            given = SimpleCookie(cookies).get(COOKIE)
        except CookieError:
            return False
        return given is not None and secrets.compare_digest(
            given.value.encode(), self._session.encode()
        )

    async def _log_in(self, receive: _Receive, send: _Send) -> None:
        body = b""
        more = True
        while more and len(body) <= _LONGEST_LOGIN:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
        token = parse_qs(body[:_LONGEST_LOGIN].decode("latin-1")).get("token", [""])[0]
        if not self._access.token_is_right(token):
            await _answer(send, 403, _PAGE.format(words="This is not the token."))
            return
        cookie = f"{COOKIE}={self._session}; Path=/; HttpOnly; SameSite=Strict"
        await _answer(send, 303, "", (b"location", b"/"), (b"set-cookie", cookie.encode()))


def _forbid_framing(send: _Send) -> _Send:
    """Forbid showing a page inside another one, which could lay it under a finger."""

    async def send_so(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = [*message.get("headers", ()), (b"x-frame-options", b"DENY")]
            message = {**message, "headers": headers}
        await send(message)

    return send_so


def _header(scope: _Scope, name: bytes) -> str:
    for key, value in scope["headers"]:
        if key == name:
            return str(value.decode("latin-1"))
    return ""


async def _refuse(scope: _Scope, send: _Send, status: int, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": why[:100]})
    else:
        await _answer(send, status, f"<!doctype html><p>Refused: {_plain(why)}</p>")


async def _answer(send: _Send, status: int, page: str, *headers: tuple[bytes, bytes]) -> None:
    more = [
        (b"content-type", b"text/html; charset=utf-8"),
        (b"cache-control", b"no-store"),
        *headers,
    ]
    await send({"type": "http.response.start", "status": status, "headers": more})
    await send({"type": "http.response.body", "body": page.encode()})


def _plain(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;")
