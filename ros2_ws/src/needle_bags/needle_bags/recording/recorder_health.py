"""Health of a recording, as the recorder publishes it in /diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from needle_bags.recording.recording import Recording, megabytes
from needle_core.diagnostics import Level

# Warn when this many bytes are queued: one second of stereo images.
WARN_WAITING: Final = 50_000_000
# Warn when the disk will be full within this time at the current rate [s], or when the free space
# is below this multiple of the reserve.
WARN_BEFORE: Final = 120.0
WARN_RESERVES: Final = 3


class RecorderHealth:
    """Periodic check of a recording.

    Parameters
    ----------
    recording : Recording
        The recording.
    bag : Path
        Directory of the bag, as given by the user.
    """

    def __init__(self, recording: Recording, bag: Path) -> None:
        self._recording = recording
        self._bag = bag
        self._bytes_before = 0
        self._rate = 0.0

    def check(
        self, period: float, lost: Mapping[str, int], refused: Sequence[str]
    ) -> tuple[Level, str]:
        """Return the level and a one-line message.

        Parameters
        ----------
        period : float
            Time since the last check [s].
        lost : mapping
            Number of messages missing from the bag, by topic.
        refused : sequence of str
            Reasons why topics are not recorded.
        """
        recording = self._recording
        received = recording.bytes_received
        # Average over about a second, because images arrive in bursts.
        self._rate += 0.5 * ((received - self._bytes_before) / period - self._rate)
        self._bytes_before = received
        if recording.error is not None:
            return Level.ERROR, f"recording ended: {recording.error}"
        if lost:
            return Level.WARN, f"messages lost on {', '.join(lost)}"
        warning = self._backlog_warning() or self._space_warning() or "; ".join(refused)
        return (Level.WARN, warning) if warning else (Level.OK, "recording")

    def _backlog_warning(self) -> str:
        waiting = self._recording.bytes_waiting
        if waiting <= WARN_WAITING:
            return ""
        return f"the disk or this machine is slower than the graph: {megabytes(waiting)} waiting"

    def _space_warning(self) -> str:
        space = self._recording.space
        try:
            usable = space.usable()
        except OSError as error:
            return f"cannot read the free space on the disk of {self._bag}: {error.strerror}"
        if usable >= max(WARN_BEFORE * self._rate, WARN_RESERVES * space.reserve):
            return ""
        reserve = megabytes(space.reserve)
        return f"the disk of {self._bag} is nearly full: recording stops at {reserve} free"
