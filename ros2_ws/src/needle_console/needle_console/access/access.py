"""Access control of connections: the rig's names, pages of its own, a secret."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
from collections.abc import Sequence
from urllib.parse import SplitResult, urlsplit

from needle_core.errors import UserError

SHORTEST_TOKEN, LONGEST_TOKEN = 16, 100
"""Length of a token [characters]."""

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class Access:
    """Judges Host, Origin and token.

    A page of another site can make a browser open connections here, but not lie about its Origin;
    one whose name was made to point here (DNS rebinding) cannot lie about the Host. What is no
    browser can lie about both: beyond this machine a token is asked for.

    Parameters
    ----------
    address : str
        What is listened on: an IP address, or `localhost`.
    page_port : int
        Port of the page: Origins of another are another site.
    token : str
        What a page has to know; may be empty on loopback only.
    hosts : sequence of str
        Names and addresses by which browsers reach this machine, without port; where a particular
        address is listened on, this one by default.

    Raises
    ------
    UserError
        If others could reach this without a token or by any name; a token that is too short or too
        long.
    """

    def __init__(
        self, address: str, page_port: int, token: str = "", hosts: Sequence[str] = ()
    ) -> None:
        known = {host.lower() for host in hosts}
        if _is_loopback(address):
            known.update(_LOOPBACK_NAMES)
        else:
            if not token:
                raise UserError(f"address = {address!r}: beyond this machine a token is needed")
            if not known and not ipaddress.ip_address(address).is_unspecified:
                known.add(address.lower())
            if not known:
                raise UserError(
                    f"address = {address!r}: hosts must name this machine as browsers do"
                )
        if token and not SHORTEST_TOKEN <= len(token) <= LONGEST_TOKEN:
            bounds = f"{SHORTEST_TOKEN} to {LONGEST_TOKEN} are needed"
            raise UserError(f"token has {len(token)} characters, {bounds}")
        self.address = address
        self._page_port = page_port
        self._hosts = frozenset(known)
        self._digest = _digest(token)
        self._needs_token = bool(token)

    @property
    def needs_token(self) -> bool:
        """Whether a page has to know a token."""
        return self._needs_token

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

    def token_is_right(self, token: str) -> bool:
        """Return whether this is the token, in a time that does not tell how much of it is."""
        return hmac.compare_digest(_digest(token), self._digest)


def _is_loopback(address: str) -> bool:
    if address == "localhost":
        return True
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError as error:
        raise UserError(f"address = {address!r} is neither an IP address nor localhost") from error


def _digest(token: str) -> bytes:
    # Of one length whatever is compared; half a surrogate pair is a wrong token, no error.
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


def _split(text: str) -> SplitResult | None:
    try:
        split = urlsplit(text)
        # Only reading it shows that it is none.
        _ = split.port
    except ValueError:
        return None
    return split
