"""The last seconds of a graph, kept in memory within a bound."""

from __future__ import annotations

import collections

from needle_bags.recording.recording import Received

_NANOSECONDS = 1e9


class RecentMessages:
    """Messages of the last seconds; older ones go, but for the last of a latched topic.

    Parameters
    ----------
    seconds : float
        How far back messages are kept.
    limit : int
        Memory for them [B]: where it is too little, fewer seconds are kept.
    """

    def __init__(self, seconds: float, limit: int) -> None:
        self._length = round(seconds * _NANOSECONDS)
        self._limit = limit
        self._messages: collections.deque[Received] = collections.deque()
        self._latched: set[str] = set()
        self._standing: dict[str, Received] = {}
        self.memory = 0

    @property
    def seconds(self) -> float:
        """Time from the oldest to the newest [s]."""
        if not self._messages:
            return 0.0
        return (self._messages[-1].log_time - self._messages[0].log_time) / _NANOSECONDS

    def latch(self, topic: str) -> None:
        """Keep the last message of this topic however old: late joiners get it, too."""
        self._latched.add(topic)

    def put(self, message: Received) -> None:
        """Take a message."""
        self._messages.append(message)
        self.memory += message.memory
        oldest = message.log_time - self._length
        while self._messages and (self.memory > self._limit or self._messages[0].log_time < oldest):
            gone = self._messages.popleft()
            self.memory -= gone.memory
            if gone.topic in self._latched:
                self._standing[gone.topic] = gone

    def take(self) -> list[Received]:
        """Return all that is kept, in order, and keep none of it."""
        messages = [*self._standing.values(), *self._messages]
        self._standing.clear()
        self._messages.clear()
        self.memory = 0
        return messages
