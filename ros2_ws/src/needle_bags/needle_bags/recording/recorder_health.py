"""Health of a recording, as its node tells it in /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from needle_bags.recording.free_space import megabytes
from needle_bags.recording.recording import Recording
from needle_core.diagnostics import Level

# Bytes that wait for the disk: a second of stereo images.
WARN_WAITING: Final = 50_000_000
# The disk is nearly full when it lasts less than this at the present rate [s], or when what is
# left is less than so many times the reserve.
WARN_BEFORE: Final = 120.0
WARN_RESERVES: Final = 3


class RecorderHealth:
    """Looks at a recording now and then.

    Parameters
    ----------
    recording : Recording
        What is recorded.
    bag : Path
        Its directory, as the user named it.
    """

    def __init__(self, recording: Recording, bag: Path) -> None:
        self._recording = recording
        self._bag = bag
        self._bytes_before = 0
        self._rate = 0.0

    def look(
        self, period: float, lost: Mapping[str, int], refused: Sequence[str]
    ) -> tuple[Level, str]:
        """Return the level and one line.

        Parameters
        ----------
        period : float
            Time since the last look [s].
        lost : mapping
            Topic to messages that are not in the bag.
        refused : sequence of str
            Why topics are not recorded.
        """
        recording = self._recording
        received = recording.bytes_received
        # A second's mean or so: images come in bursts.
        self._rate += 0.5 * ((received - self._bytes_before) / period - self._rate)
        self._bytes_before = received
        if recording.error is not None:
            return Level.ERROR, f"recording ended: {recording.error}"
        if lost:
            return Level.WARN, f"messages lost on {', '.join(lost)}"
        warning = self._waiting() or self._space() or "; ".join(refused)
        return (Level.WARN, warning) if warning else (Level.OK, "recording")

    def _waiting(self) -> str:
        waiting = self._recording.bytes_waiting
        if waiting <= WARN_WAITING:
            return ""
        return f"the disk, or this machine, is slower than the graph: {megabytes(waiting)} wait"

    def _space(self) -> str:
        space = self._recording.space
        try:
            usable = space.usable()
        except OSError as error:
            return f"cannot look at the disk of {self._bag}: {error.strerror}"
        if usable >= max(WARN_BEFORE * self._rate, WARN_RESERVES * space.reserve):
            return ""
        reserve = megabytes(space.reserve)
        return f"the disk of {self._bag} is nearly full: recording ends at {reserve} free"
