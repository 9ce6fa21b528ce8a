"""End of a tick of simulated time at level drive: both sides have answered, all is heard."""

from __future__ import annotations

# So many looks in a row in which nothing more was heard: topics have no order among each other.
_QUIET_LOOKS = 1


class DrivenTick:
    """Follows one tick at a time.

    Parameters
    ----------
    timeout : float
        How long a tick may stay unanswered [s].
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        self.unanswered = 0
        self._time_ns: int | None = None
        self._begun_at = 0.0
        self._driver_ns = -1
        self._drives_moved = False
        self._quiet = 0

    @property
    def answered(self) -> bool:
        """Tell whether both sides have answered; what they said before may still be on its way."""
        return self._driver_is_done and self._drives_moved

    @property
    def silent(self) -> str:
        """Names of those who have not answered."""
        names = [
            name
            for name, done in (
                ("the driver (joint_states)", self._driver_is_done),
                ("the drives (sim/drive_positions)", self._drives_moved),
            )
            if not done
        ]
        return " and ".join(names)

    def begin(self, time_ns: int, now: float) -> None:
        """Take that time is `time_ns` [ns] from now [s] on."""
        self._time_ns = time_ns
        self._begun_at = now
        self._drives_moved = False
        self._quiet = 0

    def driver_at(self, time_ns: int) -> None:
        """Take that the driver has done its cycle of `time_ns` [ns]."""
        self._driver_ns = time_ns

    def drives_moved(self) -> None:
        """Take that the drives have told where they are; they do for each SYNC."""
        self._drives_moved = True

    def heard(self) -> None:
        """Take that something was heard."""
        self._quiet = 0

    def look(self) -> None:
        """Take that the executor has looked once more."""
        self._quiet += 1

    def is_over(self, now: float) -> bool:
        """Return whether the tick is over; one that took too long is counted and over, too."""
        if self.answered:
            return self._quiet > _QUIET_LOOKS
        if now - self._begun_at < self.timeout:
            return False
        self.unanswered += 1
        return True

    @property
    def _driver_is_done(self) -> bool:
        return self._time_ns is not None and self._driver_ns >= self._time_ns
