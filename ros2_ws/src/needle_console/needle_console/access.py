"""Access control for page and hold, by the Host and Origin headers of connections."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from needle_core.errors import UserError

_Scope: TypeAlias = MutableMapping[str, Any]
_Receive: TypeAlias = Callable[[], Awaitable[MutableMapping[str, Any]]]
_Send: TypeAlias = Callable[[MutableMapping[str, Any]], Awaitable[None]]
_App: TypeAlias = Callable[[_Scope, _Receive, _Send], Awaitable[None]]

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Access:
    """Check of the Host and Origin of connections.

    A page of another site can make a browser open connections here, but cannot forge its Origin. A
    site whose name resolves to this machine (DNS rebinding) cannot forge the Host.

    Parameters
    ----------
    address : str
        Address to listen on: an IP address, or `localhost`.
    page_port : int
        Port of the page; an Origin with another port is another site.
    hosts : sequence of str
        Names and addresses by which browsers reach this machine, without port; by default
        `address`, if it is a specific one.

    Raises
    ------
    UserError
        If `address` is unspecified and `hosts` is empty, or `address` is invalid.
    """

    def __init__(self, address: str, page_port: int, hosts: Sequence[str] = ()) -> None:
        known = {host.lower() for host in hosts}
        if _is_loopback(address):
            known.update(_LOOPBACK_NAMES)
        elif not known and not ipaddress.ip_address(address).is_unspecified:
            known.add(address.lower())
        if not known:
            raise UserError(f"address = {address!r}: hosts must name this machine as browsers do")
        self.address = address
        self._hosts = frozenset(known)
        self._origins = frozenset(
            f"{scheme}://{f'[{host}]' if ':' in host else host}{port}"
            for scheme, default_port in (("http", 80), ("https", 443))
            # Browsers leave out a default port.
            for port in (f":{page_port}", "" if page_port == default_port else f":{page_port}")
            for host in known
        )

    def host_refusal(self, header: str | None) -> str:
        """Return the reason to refuse a Host header; empty if it is accepted."""
        try:
            split = urlsplit(f"//{header or ''}")
            _ = split.port  # raises for an invalid port
        except ValueError:
            return "foreign Host"
        known = split.hostname in self._hosts and split.username is None
        return "" if known else "foreign Host"

    def origin_refusal(self, header: str | None) -> str:
        """Return the reason to refuse an Origin, which pages always send; empty if accepted."""
        return "" if (header or "").lower() in self._origins else "foreign Origin"


def listening_socket(address: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 selects a free port.

    Connections that arrive before the server starts are queued, not refused.

    Raises
    ------
    UserError
        If the port is taken, or the address does not belong to this machine.
    """
    try:
        return socket.create_server(
            (address, port), family=socket.AF_INET6 if ":" in address else socket.AF_INET
        )
    except OSError as error:
        raise UserError(f"cannot listen on {address}:{port}: {error.strerror}") from error


def _is_loopback(address: str) -> bool:
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise UserError(f"address = {address!r} is neither an IP address nor localhost") from error


class Gate:
    """ASGI application that checks requests before it passes them to another application.

    Parameters
    ----------
    app : callable
        The other application, also available as an attribute.
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
        why = self._refusal_reason(scope)
        if why:
            await _refuse(scope, send, why)
        else:
            await self.app(scope, receive, send)

    def _refusal_reason(self, scope: _Scope) -> str:
        why = self._access.host_refusal(_header(scope, b"host"))
        origin = _header(scope, b"origin")
        changes = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if not why and (origin or changes):
            why = self._access.origin_refusal(origin)
        return why


def _forbid_framing(send: _Send) -> _Send:
    """Prevent other pages from embedding this one, which could redirect a press to it."""

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
