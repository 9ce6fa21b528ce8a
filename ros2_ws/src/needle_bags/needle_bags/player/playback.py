"""Clock of the player, and a thread that reads messages ahead."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")
_NANOSECONDS = 1e9
# Number of messages read ahead: one second of stereo images, less than 60 MB.
READ_AHEAD = 64


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


class ReadAhead(Generic[T]):
    """Runs an iterator ahead in its own thread.

    Parameters
    ----------
    make : callable
        Makes the iterator, inside the thread.
    """

    def __init__(self, make: Callable[[], Iterator[T]]) -> None:
        self._make = make
        self._items: queue.Queue[tuple[T | None, Exception | None]] = queue.Queue(READ_AHEAD)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bag_reader", daemon=True)
        self._thread.start()

    def next(self) -> T | None:
        """Return the next item, None at the end; re-raises exceptions of the iterator."""
        item, error = self._items.get()
        if error is not None:
            raise error
        return item

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            for item in self._make():
                if not self._put(item, None):
                    return
            self._put(None, None)
        # next() re-raises it.
        except Exception as error:  # noqa: BLE001
            self._put(None, error)

    def _put(self, item: T | None, error: Exception | None) -> bool:
        while not self._closed.is_set():
            try:
                self._items.put((item, error), timeout=0.1)
            except queue.Full:
                continue
            return True
        return False
