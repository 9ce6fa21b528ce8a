"""Number of lost messages, from gaps in the sequence numbers."""

from __future__ import annotations

# A gap is final once this many messages have arrived after it.
FINAL_AFTER = 5


class SequenceGaps:
    """Gaps in the sequence numbers of a topic with one publisher.

    Every publisher counts from 1, and messages do not identify their publisher. A jump may
    therefore be the first message of a second publisher that has not been discovered yet. This is
    the case if the numbers before the jump continue.
    """

    def __init__(self) -> None:
        self._missing = 0
        self._last: int | None = None
        # Last number before a jump, size of the gap, number of messages since.
        self._jump: tuple[int, int, int] | None = None

    @property
    def missing(self) -> int:
        """Number of lost messages."""
        return self._missing + (self._jump[1] if self._jump is not None else 0)

    def add(self, number: int) -> None:
        """Add the number of a received message."""
        if self._jump is not None:
            before, count, since = self._jump
            if number == before + 1:
                self._jump = None
                return
            self._jump = (before, count, since + 1)
            if since + 1 >= FINAL_AFTER:
                self._settle()
        if self._last is not None and number > self._last + 1:
            self._settle()
            self._jump = (self._last, number - self._last - 1, 0)
        self._last = number

    def reset(self) -> None:
        """Start over after a change of the publishers."""
        self._jump = None
        self._last = None

    def _settle(self) -> None:
        self._missing, self._jump = self.missing, None
