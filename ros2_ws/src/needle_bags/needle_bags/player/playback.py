"""Clock of the player."""

from __future__ import annotations

_NANOSECONDS = 1e9


class PlaybackClock:
    """Maps steady time to recording time, with a rate and pauses.

    Parameters
    ----------
    rate : float
        Ratio of playback speed to recording speed.
    start : int
        Recording time at the start [ns].
    now : float
        Steady time [s].
    paused : bool
        Whether to start paused.

    Attributes
    ----------
    rate : float
        The current rate.
    """

    def __init__(self, rate: float, start: int, now: float, *, paused: bool = False) -> None:
        self.rate = rate
        self.is_paused = paused
        self._since = now
        self._time = float(start)

    def restart(self, start: int, now: float) -> None:
        """Jump to a recording time [ns]; a paused clock stays paused."""
        self._time, self._since = float(start), now

    def pause(self, paused: bool, now: float) -> None:
        """Pause or continue."""
        self._time, self._since = self._at(now), now
        self.is_paused = paused

    def set_rate(self, rate: float, now: float) -> None:
        """Change the rate."""
        self._time, self._since = self._at(now), now
        self.rate = rate

    def time(self, now: float) -> int:
        """Return the recording time [ns] at a steady time [s]."""
        return int(self._at(now))

    def wait(self, time: int, now: float) -> float:
        """Return the time [s] until a recording time [ns]; infinite while paused."""
        if self.is_paused:
            return float("inf")
        return max(0.0, (time - self._at(now)) / (_NANOSECONDS * self.rate))

    def _at(self, now: float) -> float:
        if self.is_paused:
            return self._time
        return self._time + (now - self._since) * _NANOSECONDS * self.rate
