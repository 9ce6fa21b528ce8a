"""Simulated times of SYNCs, which do not say so themselves."""

from __future__ import annotations

# Not one: at the start nobody knows whether the first time heard had a SYNC.
_UNCLEAR = 2


class SyncStamps:
    """Pairs SYNCs with simulated times, one SYNC a time.

    The sender of a SYNC may know its time before it is known here. One new time since the SYNC
    before is it; where it is not as clear (at the start, after SYNCs that failed to come), the
    newest is, after some patience.

    Parameters
    ----------
    patience : float
        How long an unclear SYNC waits for its time [s], steady clock.
    """

    def __init__(self, patience: float) -> None:
        self._patience = patience
        self._time_ns = 0
        self._new_times = _UNCLEAR
        self._waiting = 0
        self._waits_since = 0.0

    @property
    def waits(self) -> bool:
        """Tell whether a SYNC waits for its time."""
        return self._waiting > 0

    @property
    def new_times(self) -> int:
        """Number of new times heard since the last SYNC that got one."""
        return self._new_times

    def hear(self, time_ns: int) -> None:
        """Take a simulated time [ns]; one that is repeated is no new one."""
        if time_ns != self._time_ns:
            self._time_ns = time_ns
            self._new_times += 1

    def sync(self, count: int, now: float) -> None:
        """Take that `count` more SYNCs have come by steady time `now` [s]."""
        if count and not self._waiting:
            self._waits_since = now
        self._waiting += count

    def take(self, now: float, *, simulated: bool) -> int | None:
        """Return the time of the SYNC that waits, if it is known.

        Parameters
        ----------
        now : float
            Steady time [s].
        simulated : bool
            Whether simulated time is told: a SYNC then waits until one was heard.

        Returns
        -------
        int or None
            Its time [ns], 0 where nobody tells any; None while it waits, or none does.
        """
        if not self._waiting or (simulated and not self._time_ns):
            return None
        patience = self._patience if simulated else 0.0
        if self._new_times != 1 and now - self._waits_since < patience:
            return None
        self._waiting = 0
        self._new_times = 0
        return self._time_ns
