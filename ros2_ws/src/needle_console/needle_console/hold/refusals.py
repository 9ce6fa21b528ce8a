"""Refused connections and messages: each kind is counted, and logged once."""

from __future__ import annotations

import collections
import enum
import threading


class Refusal(enum.Enum):
    """Reason for which a connection or message does not count; the value is for a person."""

    HOST = "foreign Host"
    ORIGIN = "foreign Origin"
    PATH = "unknown path"
    GARBAGE = "message not understood"
    ECHO = "no new echo of this connection"
    STALE = "message too old"
    NEW_PRESS = "press again"
    BARRED = "page may not hold"
    LOST = "hold lost"
    SILENT = "silent page"


class Refusals:
    """Counts refusals, by any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: collections.Counter[Refusal] = collections.Counter()

    def count(self, refusal: Refusal) -> bool:
        """Count one; return whether it is the first of its kind."""
        with self._lock:
            self._counts[refusal] += 1
            return self._counts[refusal] == 1

    def counts(self) -> dict[str, int]:
        """Return how many there were of each kind."""
        with self._lock:
            return {refusal.value: number for refusal, number in self._counts.items()}
