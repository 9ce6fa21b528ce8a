"""Access control of the page: checks every request, also upgrades to WebSockets."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, TypeAlias

from needle_console.access import Access

_Scope: TypeAlias = MutableMapping[str, Any]
_Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
_Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
_App: TypeAlias = Callable[[_Scope, _Receive, _Send], Awaitable[None]]


class Gate:
    """ASGI application that checks requests before another application.

    Parameters
    ----------
    app : callable
        The other application; also an attribute.
    access : Access
        Checks the requests.
    """

    def __init__(self, app: _App, access: Access) -> None:
        self.app = app
        self._access = access

    async def __call__(self, scope: _Scope, receive: _Receive, send: _Send) -> None:
        """Refuse a connection, or pass it on."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        send = _forbid_framing(send)
        why = self._why_not(scope)
        if why:
            await _refuse(scope, send, why)
        else:
            await self.app(scope, receive, send)

    def _why_not(self, scope: _Scope) -> str:
        why = self._access.why_not_host(_header(scope, b"host"))
        origin = _header(scope, b"origin")
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if not why and (origin or changes):
            why = self._access.why_not_origin(origin)
        return why


def _forbid_framing(send: _Send) -> _Send:
    """Forbid to show the page inside another one, which could redirect a press to it."""

    async def send_with_header(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            headers = [*message.get("headers", ()), (b"x-frame-options", b"DENY")]
            message = {**message, "headers": headers}
        await send(message)

    return send_with_header


def _header(scope: _Scope, name: bytes) -> str:
    for key, value in scope["headers"]:
        if key == name:
            return str(value.decode("latin-1"))
    return ""


async def _refuse(scope: _Scope, send: _Send, why: str) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": why})
        return
    headers = [(b"content-type", b"text/plain"), (b"cache-control", b"no-store")]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": f"Refused: {why}\n".encode()})
