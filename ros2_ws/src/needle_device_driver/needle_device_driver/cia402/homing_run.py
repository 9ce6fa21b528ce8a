"""A homing under way in a drive (CiA 402 homing mode)."""

from __future__ import annotations

import enum

from needle_device_driver.cia402.cia402 import (
    HOMING_ATTAINED,
    HOMING_ERROR,
    TARGET_REACHED,
    DriveState,
    Mode,
    drive_state,
)
from needle_device_driver.cia402.drive_monitor import Feedback

# A homing where the axis stands ends within a cycle; so many later its end is believed although
# the drive never took the end of the one before back.
_INSTANT = 5


class HomingStep(enum.Enum):
    """Stages of a homing."""

    PREPARING = "preparing"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


class HomingRun:
    """Follows a homing from the order to its end.

    Parameters
    ----------
    here : bool
        Whether the drive takes where it stands as home, without moving.
    tolerance_counts : int
        How far from 0 it may then say that it is.
    """

    def __init__(self, *, here: bool, tolerance_counts: int) -> None:
        self._here = here
        self._tolerance_counts = tolerance_counts
        self._cycles = 0
        self._stale = False
        self.step = HomingStep.PREPARING

    def update(self, at: Feedback) -> None:
        """Take what the drive says now."""
        attained = bool(at.statusword & HOMING_ATTAINED)
        ended = attained and bool(at.statusword & TARGET_REACHED)
        if self.step is HomingStep.PREPARING:
            if drive_state(at.statusword) is DriveState.OPERATION_ENABLED and (
                at.mode == Mode.HOMING
            ):
                # A drive may still say that it attained the homing before: not this one's end.
                self._stale = attained
                self.step = HomingStep.RUNNING
            return
        if self.step is not HomingStep.RUNNING:
            return
        self._cycles += 1
        if at.statusword & HOMING_ERROR:
            self.step = HomingStep.FAILED
            return
        # Some drives keep the first bit for good; the second goes with each homing's begin.
        self._stale = self._stale and ended
        if self._stale:
            near = abs(at.position) <= self._tolerance_counts
            done = self._here and near and self._cycles >= _INSTANT
        else:
            done = ended
        if done:
            self.step = HomingStep.DONE
