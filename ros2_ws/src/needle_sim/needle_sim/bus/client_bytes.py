"""Bytes of one of several clients of a connection."""

from __future__ import annotations


class ClientBytes(bytes):
    """Bytes from or for one client.

    Plain bytes are of client 0, the only one of a connection between components.

    Parameters
    ----------
    data : bytes
        The bytes.
    client : int
        Number of the client.
    """

    client: int

    def __new__(cls, data: bytes, client: int) -> ClientBytes:
        """Return the bytes, marked with their client."""
        made = super().__new__(cls, data)
        made.client = client
        return made
