"""Marks that tell when a page last heard of us, by our own clock."""

from __future__ import annotations

import collections
from collections.abc import Callable


class Nonces:
    """Nonces sent to one page, with their times.

    Parameters
    ----------
    make : callable
        Returns a text that nobody can guess.
    """

    MOST = 13
    """Most nonces that wait for their echo: 0.26 s of them, so that all younger ones may count."""

    def __init__(self, make: Callable[[], str]) -> None:
        self._make = make
        self._issued: collections.deque[tuple[str, float]] = collections.deque()
        self._echoed = ""

    def issue(self, now: float) -> str | None:
        """Return a new one, sent now [s]; None while the page is behind with answers."""
        waiting = len(self._issued) - (bool(self._issued) and self._issued[0][0] == self._echoed)
        if waiting >= self.MOST:
            return None
        nonce = self._make()
        self._issued.append((nonce, now))
        return nonce

    def take(self, nonce: str) -> float | None:
        """Take an echo; return when its nonce was sent [s].

        Returns
        -------
        float or None
            None where it was never sent, or before one that was echoed already.
        """
        if all(nonce != known for known, _ in self._issued):
            return None
        while self._issued[0][0] != nonce:
            self._issued.popleft()
        self._echoed = nonce
        return self._issued[0][1]
