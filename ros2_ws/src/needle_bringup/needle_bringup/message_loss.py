"""Counts the messages that did not arrive, by the numbers that their publishers give them."""

from __future__ import annotations


class SequenceGaps:
    """The gaps in the numbers of one topic's messages.

    Every publisher counts its messages from 1, and a message does not say which publisher it is
    from. A number that follows the last one of a publisher belongs to that one; a gap is counted
    where only one publisher can have it.

    Attributes
    ----------
    missing : int
        Messages that did not arrive, for certain.
    """

    def __init__(self) -> None:
        self.missing = 0
        self._last: list[int] = []

    def take(self, number: int) -> None:
        """Take the number of a message that has arrived."""
        last = self._last
        if number - 1 in last:
            last[last.index(number - 1)] = number
        elif len(last) == 1 and number > last[0]:
            self.missing += number - last[0] - 1
            last[0] = number
        elif number not in last:
            last.append(number)

    def forget(self) -> None:
        """Begin anew: other publishers may be there."""
        self._last.clear()
