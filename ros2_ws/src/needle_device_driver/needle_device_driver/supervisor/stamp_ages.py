"""The age of a ROS stamp on the steady clock, whatever ROS time does."""

from __future__ import annotations

import bisect
import math

# A sender's clock may be ahead of what was noted here by its latency, not by more [ns].
AHEAD_NS = 100_000_000


class StampAges:
    """Notes when ROS time was what, so that a stamp's age can be told without ROS time.

    A simulation that runs faster than real time would make every tip look old, one that stands
    still would make an old tip look fresh; the steady clock does neither.

    Parameters
    ----------
    horizon : float
        How long notes are kept [s]; ages beyond are infinite.
    """

    def __init__(self, horizon: float) -> None:
        self._horizon = horizon
        self._ros_ns: list[int] = []
        self._last_seen: list[float] = []

    @property
    def newest_ns(self) -> int | None:
        """The ROS time that was noted last [ns]; None: none yet."""
        return self._ros_ns[-1] if self._ros_ns else None

    def note(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns] at steady time `now` [s]."""
        if self._ros_ns and ros_ns < self._ros_ns[-1]:
            # Time was set back: no stamp from before can be aged.
            self._ros_ns.clear()
            self._last_seen.clear()
        if self._ros_ns and ros_ns == self._ros_ns[-1]:
            self._last_seen[-1] = now
            return
        self._ros_ns.append(ros_ns)
        self._last_seen.append(now)
        old = bisect.bisect_left(self._last_seen, now - self._horizon)
        # Cutting the list costs its length: do it seldom.
        if old > 1000:
            del self._ros_ns[: old - 1]
            del self._last_seen[: old - 1]

    def age(self, stamp_ns: int, now: float) -> float:
        """Return how long ago `stamp_ns` was the ROS time, at most [s].

        Returns
        -------
        float
            Infinite for a stamp not newer than the first note; negative for one from the future.
        """
        if self._ros_ns and stamp_ns > self._ros_ns[-1] + AHEAD_NS:
            return (self._ros_ns[-1] - stamp_ns) * 1e-9
        after = bisect.bisect_left(self._ros_ns, stamp_ns)
        # The stamp became current at the earliest when the note before it was last seen.
        return now - self._last_seen[after - 1] if after > 0 else math.inf
