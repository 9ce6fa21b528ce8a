"""Clock and keys of the player."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import tty
from typing import Any, Final

_NANOSECONDS = 1e9
PAUSE: Final = " "
FASTER: Final = "\x1b[A"
SLOWER: Final = "\x1b[B"
FORWARD: Final = "\x1b[C"
BACK: Final = "\x1b[D"
# A terminal sends an arrow key as three characters; in application mode, the second is O.
_KEY: Final = re.compile(r"\x1b[\[O][A-D]|.", re.DOTALL)


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


def keys_in(text: str) -> list[str]:
    """Split the characters from a terminal into keys."""
    return [key.replace("\x1bO", "\x1b[") for key in _KEY.findall(text)]


class Keys:
    """Keys pressed in the terminal; none without a terminal."""

    def __init__(self) -> None:
        self._file = sys.stdin.fileno() if sys.stdin is not None and sys.stdin.isatty() else None
        self._before: list[Any] = []

    def __enter__(self) -> Keys:
        if self._file is not None:
            self._before = termios.tcgetattr(self._file)
            tty.setcbreak(self._file)
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call."""
        if self._file is None or not select.select([self._file], [], [], 0.0)[0]:
            return []
        return keys_in(os.read(self._file, 256).decode(errors="replace"))
