"""The last seconds of messages, kept in memory for a snapshot."""

from __future__ import annotations

import collections

from needle_bags.recording.recording import Received

_NANOSECONDS = 1e9


class RecentMessages:
    """Messages of the last seconds, and the last message of each latched topic.

    Parameters
    ----------
    seconds : float
        Time for which messages are kept [s].
    limit : int
        Memory limit [B]; when it is reached, the oldest messages are dropped earlier.
    """

    def __init__(self, seconds: float, limit: int) -> None:
        self._length = round(seconds * _NANOSECONDS)
        self._limit = limit
        self._messages: collections.deque[Received] = collections.deque()
        self._latched: set[str] = set()
        self._last_latched: dict[str, Received] = {}
        self.memory = 0

    @property
    def seconds(self) -> float:
        """Time from the oldest to the newest message [s]."""
        if not self._messages:
            return 0.0
        return (self._messages[-1].log_time - self._messages[0].log_time) / _NANOSECONDS

    def latch(self, topic: str) -> None:
        """Keep the last message of this topic regardless of its age, as latched topics do."""
        self._latched.add(topic)

    def put(self, message: Received) -> None:
        """Add a message and drop those that are too old."""
        self._messages.append(message)
        self.memory += message.memory
        oldest = message.log_time - self._length
        while self._messages and (self.memory > self._limit or self._messages[0].log_time < oldest):
            dropped = self._messages.popleft()
            self.memory -= dropped.memory
            if dropped.topic in self._latched:
                self._last_latched[dropped.topic] = dropped

    def drain(self) -> list[Received]:
        """Return all kept messages in order and clear the buffer."""
        messages = [*self._last_latched.values(), *self._messages]
        self._last_latched.clear()
        self._messages.clear()
        self.memory = 0
        return messages
