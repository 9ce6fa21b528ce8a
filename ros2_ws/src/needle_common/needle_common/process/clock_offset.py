"""Offset of another computer's clock, from questions that it answered."""

from __future__ import annotations

import collections
import dataclasses

# A reading is kept so long [ns]: a clock that is off by 100 ppm drifts by 1 ms in it.
_KEPT_NS = 10_000_000_000


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """Offset of a clock against one's own.

    Attributes
    ----------
    ahead : float
        The middle of what is possible [s].
    within : float
        It is no farther from the middle than this [s]: half the way there and back.
    """

    ahead: float
    within: float

    @property
    def least_difference(self) -> float:
        """Least difference of the two clocks [s]."""
        return max(abs(self.ahead) - self.within, 0.0)


def clock_offset(asked_ns: int, answered_ns: int, heard_ns: int) -> ClockOffset:
    """Return what is known of a clock that was asked for its time, as NTP (RFC 5905) does.

    The answer was given after the question and before it was heard, wherever in between: with one
    way alone a slow network could not be told from a clock that is behind.

    Parameters
    ----------
    asked_ns, heard_ns : int
        When the question was sent, and the answer heard, by one's own clock [ns].
    answered_ns : int
        When the answer was sent, by the other clock [ns].
    """
    middle_ns = (asked_ns + heard_ns) / 2.0
    return ClockOffset((answered_ns - middle_ns) * 1e-9, (heard_ns - asked_ns) / 2.0 * 1e-9)


class ClockReadings:
    """Answers of the last 10 s about one clock."""

    def __init__(self) -> None:
        self._readings: collections.deque[tuple[int, ClockOffset]] = collections.deque()

    def add(self, asked_ns: int, answered_ns: int, heard_ns: int) -> None:
        """Take an answer, as `clock_offset` does."""
        offset = clock_offset(asked_ns, answered_ns, heard_ns)
        if offset.within >= 0.0:
            # Else one's own clock was set back meanwhile.
            self._readings.append((heard_ns, offset))

    def best(self, now_ns: int) -> ClockOffset | None:
        """Return the narrowest of them; None where there was no answer."""
        while self._readings and not 0 <= now_ns - self._readings[0][0] <= _KEPT_NS:
            self._readings.popleft()
        offsets = (offset for _, offset in self._readings)
        return min(offsets, key=lambda offset: offset.within, default=None)
