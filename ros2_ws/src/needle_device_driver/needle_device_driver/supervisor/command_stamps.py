"""Which stamps a command may bear."""

from __future__ import annotations

from collections import deque

from needle_device_driver.supervisor.stamp_ages import AHEAD_NS, StampAges

# More than an insertion has.
_REMEMBERED_STEPS = 2000


class CommandStamps:
    """Remembers the stamps of accepted commands, and when they were the ROS time.

    Parameters
    ----------
    horizon : float
        Up to which age stamps can be told apart [s].
    """

    def __init__(self, horizon: float) -> None:
        self._ages = StampAges(horizon)
        self._last_ns: int | None = None
        self._used_ns: deque[int] = deque(maxlen=_REMEMBERED_STEPS)

    def note(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns] at steady time `now` [s]."""
        self._ages.note(ros_ns, now)

    def age(self, stamp_ns: int, now: float) -> float:
        """Return the age of a stamp as `StampAges.age` does [s]."""
        return self._ages.age(stamp_ns, now)

    def use(self, stamp_ns: int) -> None:
        """Take the stamp of a command that is accepted."""
        self._last_ns = stamp_ns
        self._used_ns.append(stamp_ns)

    def why_not_new(self, stamp_ns: int) -> str:
        """Return why no command may bear a stamp any more; empty: one may."""
        last, newest = self._last_ns, self._ages.newest_ns
        if last is not None and stamp_ns <= last:
            went_back = newest is not None and last > newest + AHEAD_NS
            way_out = "; ROS time went back, device/reset lets commands in again"
            return f"stamp {stamp_ns} ns is not newer than the last, {last} ns" + (
                way_out if went_back else ""
            )
        if stamp_ns in self._used_ns:
            return f"stamp {stamp_ns} ns is that of an earlier command"
        return ""

    def readmit(self) -> None:
        """Let in commands stamped after a time that went back; used stamps stay used."""
        if self._last_ns is not None and self._ages.newest_ns is not None:
            self._last_ns = min(self._last_ns, self._ages.newest_ns)
