"""Age and novelty of the stamps of commands."""

from __future__ import annotations

import bisect
import math
from collections import deque

# Tolerated lead of a sender's clock over the noted ROS time, for example due to latency [ns].
_MAX_LEAD_NS = 100_000_000
# Two minutes of cycles, twice the largest `tip_age_limit`.
_MAX_NOTES = 6000
# Exceeds the number of steps of an insertion.
_MAX_REMEMBERED = 2000


class CommandStamps:
    """Measures the age of stamps on the steady clock, and remembers the accepted ones.

    ROS time may be simulated, stepped or paused: ages in it would make every tip look old, or an
    old tip look fresh. So the class notes pairs of ROS time and steady time.

    An age beyond the oldest note is infinite.
    """

    def __init__(self) -> None:
        # Noted ROS times, and the steady time at which each was last observed.
        self._ros_ns: deque[int] = deque(maxlen=_MAX_NOTES)
        self._observed: deque[float] = deque(maxlen=_MAX_NOTES)
        self._last_ns: int | None = None
        self._used_ns: deque[int] = deque(maxlen=_MAX_REMEMBERED)

    def note(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns] at steady time `now` [s]."""
        if self._ros_ns and ros_ns < self._ros_ns[-1]:
            # ROS time was set back: the ages of earlier stamps are unknown.
            self._ros_ns.clear()
            self._observed.clear()
        if self._ros_ns and ros_ns == self._ros_ns[-1]:
            self._observed[-1] = now
            return
        self._ros_ns.append(ros_ns)
        self._observed.append(now)

    def age(self, stamp_ns: int, now: float) -> float:
        """Return an upper bound on the time since `stamp_ns` was the ROS time [s].

        Returns
        -------
        float
            Infinite for a stamp not newer than the first note; negative for a future stamp.
        """
        if self._ros_ns and stamp_ns > self._ros_ns[-1] + _MAX_LEAD_NS:
            return (self._ros_ns[-1] - stamp_ns) * 1e-9
        after = bisect.bisect_left(self._ros_ns, stamp_ns)
        # The stamp was current at the earliest when the note before it was last observed.
        return now - self._observed[after - 1] if after > 0 else math.inf

    def accept(self, stamp_ns: int) -> None:
        """Remember the stamp of an accepted command."""
        self._last_ns = stamp_ns
        self._used_ns.append(stamp_ns)

    def refusal_reason(self, stamp_ns: int) -> str:
        """Return why a stamp is not new; empty: it is new."""
        last = self._last_ns
        if last is not None and stamp_ns <= last:
            went_back = bool(self._ros_ns) and last > self._ros_ns[-1] + _MAX_LEAD_NS
            hint = "; ROS time jumped back: call device/reset to accept commands again"
            return f"stamp {stamp_ns} ns is not newer than the last, {last} ns" + (
                hint if went_back else ""
            )
        if stamp_ns in self._used_ns:
            return f"stamp {stamp_ns} ns is that of an earlier command"
        return ""

    def clear_rejections(self) -> None:
        """Accept new commands again after ROS time went back; used stamps stay used."""
        if self._last_ns is not None and self._ros_ns:
            self._last_ns = min(self._last_ns, self._ros_ns[-1])
