"""Homing of one drive."""

from __future__ import annotations

import enum

from needle_device_driver.axes.axis_settings import PRESENT_POSITION_METHODS
from needle_device_driver.cia402.cia402 import (
    HOMING_ATTAINED,
    HOMING_ERROR,
    TARGET_REACHED,
    DriveState,
    Mode,
    drive_state,
)
from needle_device_driver.cia402.drive_monitor import Feedback
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link import objects as od

# A drive may still report the previous homing as attained. If the new one ends within a cycle, at
# the present position or the edge of the switch, the report does not change. So it counts as ended
# after this number of cycles at home: for homing at the present position, and for one to a switch.
_CYCLES_HERE, _CYCLES_AT_SWITCH = 5, 25
# Methods that end at a limit switch: its direction in counts, its bit of the digital inputs.
_TOWARDS = {17: (-1, od.NEGATIVE_LIMIT_SWITCH), 18: (1, od.POSITIVE_LIMIT_SWITCH)}


class HomingStep(enum.Enum):
    """Stages of a homing."""

    PREPARING = "preparing"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


class HomingRun:
    """A homing under way in a drive (CiA 402 homing mode).

    Parameters
    ----------
    settings : DriveSettings
        The drive.
    speed : float
        Speed towards the switch [m/s or rad/s].
    has_inputs : bool
        Whether the drive reports its limit switches.

    Attributes
    ----------
    step : HomingStep
        Stage of the homing.
    problem : str
        Reason to abort the homing; empty: none.
    """

    def __init__(self, settings: DriveSettings, speed: float, *, has_inputs: bool) -> None:
        self._settings = settings
        self.speed = speed
        # An index pulse lies within one turn beyond the switch; without it, the turn is 0.
        turn = settings.counts_per_turn / settings.counts_per_unit
        self._longest = settings.longest_search + turn
        towards = _TOWARDS.get(settings.homing_method) if has_inputs else None
        self._towards, self._switch = towards or (0, 0)
        self._travelled = self._cycles_at_home = 0
        self.problem = ""
        self._reports_previous = False
        self.step = HomingStep.PREPARING

    def update(self, at: Feedback, moved: int) -> None:
        """Handle the newest answer, and the motion since the previous one [counts]."""
        attained = bool(at.statusword & HOMING_ATTAINED)
        ended = attained and bool(at.statusword & TARGET_REACHED)
        if self.step is HomingStep.PREPARING:
            if drive_state(at.statusword) is DriveState.OPERATION_ENABLED and (
                at.mode == Mode.HOMING
            ):
                self._reports_previous = attained
                self.step = HomingStep.RUNNING
            return
        if at.statusword & HOMING_ERROR:
            self.step = HomingStep.FAILED
            self.problem = "reports that homing failed"
            return
        self._check_travel(at, moved)
        # Some drives never reset the first bit; the second one is reset when a homing begins.
        self._reports_previous = self._reports_previous and ended
        if self._reports_previous:
            near = abs(at.position) <= self._settings.magnitude(self._settings.tolerance)
            self._cycles_at_home = self._cycles_at_home + 1 if near else 0
            here = self._settings.homing_method in PRESENT_POSITION_METHODS
            ended = self._cycles_at_home >= (_CYCLES_HERE if here else _CYCLES_AT_SWITCH)
        if ended:
            self.step = HomingStep.DONE

    def _check_travel(self, at: Feedback, moved: int) -> None:
        """Check the distance from the start, and the direction until the switch is active."""
        settings = self._settings
        self._travelled += moved
        if at.inputs & self._switch:
            self._towards = 0
        distance = abs(self._travelled) / settings.counts_per_unit
        if distance > self._longest:
            self.problem = (
                f"moved {settings.text(distance)} without finding home, limit "
                f"{settings.text(self._longest)}"
            )
        elif self._travelled * self._towards < 0 and distance > settings.following_error:
            self.problem = (
                f"moved {settings.text(distance)} away from the limit switch of homing method "
                f"{settings.homing_method}: check the directions of motor and switches"
            )
