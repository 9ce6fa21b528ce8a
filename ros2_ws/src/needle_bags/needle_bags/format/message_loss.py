"""Counts the messages that did not arrive, by the numbers that their publishers give them."""

from __future__ import annotations

# A gap counts once so many messages have followed it and nothing has come from within it.
CERTAIN_AFTER = 5


class SequenceGaps:
    """The gaps in the numbers of one topic's messages, where it has one publisher.

    Every publisher counts its messages from 1, and a message does not say which publisher it is
    from: a jump may be a second publisher's first message that came before the graph told of it.
    Where the numbers before the jump go on, it was.
    """

    def __init__(self) -> None:
        self._missing = 0
        self._last: int | None = None
        # Last number before a jump, how many it passed over, messages since.
        self._jump: tuple[int, int, int] | None = None

    @property
    def missing(self) -> int:
        """Messages that did not arrive."""
        return self._missing + (self._jump[1] if self._jump is not None else 0)

    def take(self, number: int) -> None:
        """Take the number of a message that has arrived."""
        if self._jump is not None:
            before, count, since = self._jump
            if number == before + 1:
                self._jump = None
                return
            self._jump = (before, count, since + 1)
            if since + 1 >= CERTAIN_AFTER:
                self._settle()
        if self._last is not None and number > self._last + 1:
            self._settle()
            self._jump = (self._last, number - self._last - 1, 0)
        self._last = number

    def forget(self) -> None:
        """Begin anew: other publishers are there, and may have been for a moment."""
        self._jump = None
        self._last = None

    def _settle(self) -> None:
        self._missing, self._jump = self.missing, None
