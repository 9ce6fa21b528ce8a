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
from needle_device_driver.cia402.drive_settings import HERE, INDEX_PULSE, DriveSettings
from needle_device_driver.link import objects as od

# A homing that ends within a cycle, as where the axis stands or on the edge of its switch, is never
# seen under way on a drive that says that it attained the one before. Its end is believed after so
# many cycles in which the axis stands at its home: where it stands, and at a switch.
_INSTANT, _AT_SWITCH = 5, 25
# Share of its travel over which an axis searches for its home.
_SEARCH = 1.2
# Methods that end at a limit switch: its direction in counts, its bit of the digital inputs.
_TOWARDS = {17: (-1, od.NEGATIVE_LIMIT_SWITCH), 18: (1, od.POSITIVE_LIMIT_SWITCH)}


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
    settings : DriveSettings
        The drive: its method, and how far the axis may go.
    speed : float
        Towards the switch [m/s or rad/s].
    switches : bool
        Whether the drive tells its limit switches.

    Attributes
    ----------
    step : HomingStep
        How far it is.
    trouble : str
        Why it must not go on; empty: it may.
    """

    def __init__(self, settings: DriveSettings, speed: float, *, switches: bool) -> None:
        self._settings = settings
        self.speed = speed
        method = settings.homing_method
        # An index pulse lies within one turn beyond the switch.
        turn = (method in INDEX_PULSE) * settings.counts_per_turn
        self._longest = _SEARCH * settings.travel + turn / settings.counts_per_unit
        self._towards, self._switch = _TOWARDS.get(method * switches, (0, 0))
        self._way = self._at_home = 0
        self.trouble = ""
        self._stale = False
        self.step = HomingStep.PREPARING

    def update(self, at: Feedback, way: int) -> None:
        """Take the newest answer, and the way since the one before [counts]."""
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
        if at.statusword & HOMING_ERROR:
            self.step = HomingStep.FAILED
            self.trouble = "reports that homing failed"
            return
        self._watch_way(at, way)
        # Some drives keep the first bit for good; the second goes with each homing's begin.
        self._stale = self._stale and ended
        if self._stale:
            near = abs(at.position) <= self._settings.magnitude(self._settings.tolerance)
            self._at_home = self._at_home + 1 if near else 0
            here = self._settings.homing_method in HERE
            ended = self._at_home >= (_INSTANT if here else _AT_SWITCH)
        if ended:
            self.step = HomingStep.DONE

    def _watch_way(self, at: Feedback, way: int) -> None:
        """Bound the way from its start, and its direction until the switch was touched."""
        settings = self._settings
        self._way += way
        if at.inputs & self._switch:
            self._towards = 0
        gone = abs(self._way) / settings.counts_per_unit
        if gone > self._longest:
            self.trouble = (
                f"went {settings.told(gone)} without finding its home, at most "
                f"{settings.told(self._longest)}"
            )
        elif self._way * self._towards < 0 and gone > settings.following_error:
            self.trouble = (
                f"went {settings.told(gone)} away from the limit switch of homing method "
                f"{settings.homing_method}: direction of the motor, of the switches?"
            )
