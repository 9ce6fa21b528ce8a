"""Access control of connections by their Host and Origin headers."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Sequence
from urllib.parse import urlsplit

from needle_core.errors import UserError

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Access:
    """Checks the Host and Origin of connections.

    A page of another site can make a browser open connections here, but cannot forge its Origin. A
    site whose name resolves to this machine (DNS rebinding) cannot forge the Host.

    Parameters
    ----------
    address : str
        Address to listen on: an IP address, or `localhost`.
    page_port : int
        Port of the page; an Origin with another port is another site.
    hosts : sequence of str
        Names and addresses by which browsers reach this machine, without port; by default the
        address, if it is a particular one.

    Raises
    ------
    UserError
        If browsers on other machines could use any name.
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

    def why_not_host(self, header: str | None) -> str:
        """Return why a Host header is refused; empty if it is not."""
        try:
            split = urlsplit(f"//{header or ''}")
            _ = split.port  # raises for an invalid port
        except ValueError:
            return "foreign Host"
        known = split.hostname in self._hosts and split.username is None
        return "" if known else "foreign Host"

    def why_not_origin(self, header: str | None) -> str:
        """Return why an Origin header is refused; empty if it is not. Pages always send one."""
        return "" if (header or "").lower() in self._origins else "foreign Origin"


def listening_socket(address: str, port: int) -> socket.socket:
    """Return a listening socket; port 0 selects a free port.

    Connections before the server starts wait, they are not refused.

    Raises
    ------
    UserError
        If the port is taken, or the address is not of this machine.
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
