"""Access control of connections: the rig's names, and pages of its own."""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from urllib.parse import SplitResult, urlsplit

from needle_core.errors import UserError

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Access:
    """Judges Host and Origin.

    A page of another site can make a browser open connections here, but not lie about its Origin;
    one whose name was made to point here (DNS rebinding) cannot lie about the Host.

    Parameters
    ----------
    address : str
        What is listened on: an IP address, or `localhost`.
    page_port : int
        Port of the page: Origins of another are another site.
    hosts : sequence of str
        Names and addresses by which browsers reach this machine, without port; where a particular
        address is listened on, this one by default.

    Raises
    ------
    UserError
        If others could reach this by any name.
    """

    def __init__(self, address: str, page_port: int, hosts: Sequence[str] = ()) -> None:
        known = {host.lower() for host in hosts}
        if _is_loopback(address):
            known.update(_LOOPBACK_NAMES)
        else:
            if not known and not ipaddress.ip_address(address).is_unspecified:
                known.add(address.lower())
            if not known:
                raise UserError(
                    f"address = {address!r}: hosts must name this machine as browsers do"
                )
        self.address = address
        self._page_port = page_port
        self._hosts = frozenset(known)

    def why_not_host(self, header: str | None) -> str:
        """Return why a Host header is refused; empty if it is not."""
        split = None if header is None else _split(f"//{header}")
        if split is not None and split.hostname in self._hosts and split.username is None:
            return ""
        return "foreign Host"

    def why_not_origin(self, header: str | None) -> str:
        """Return why an Origin header is refused; empty if it is not. Pages always send one."""
        split = None if header is None else _split(header)
        if (
            split is not None
            and split.scheme in ("http", "https")
            and split.hostname in self._hosts
            and split.username is None
            and not (split.path or split.query or split.fragment)
            and (split.port or {"http": 80, "https": 443}[split.scheme]) == self._page_port
        ):
            return ""
        return "foreign Origin"


def _is_loopback(address: str) -> bool:
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise UserError(f"address = {address!r} is neither an IP address nor localhost") from error


def _split(text: str) -> SplitResult | None:
    try:
        split = urlsplit(text)
        # Only reading it shows that it is none.
        _ = split.port
    except ValueError:
        return None
    return split
