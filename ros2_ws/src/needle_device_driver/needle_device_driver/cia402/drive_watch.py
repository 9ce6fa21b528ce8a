"""Supervision of one drive: its speed, its homing, and its faults."""

from __future__ import annotations

import enum
import math

from needle_device_driver.cia402.cia402 import (
    FAULTS,
    FOLLOWING_ERROR,
    HOMING_ATTAINED,
    HOMING_ERROR,
    TARGET_REACHED,
    DriveState,
    Mode,
    drive_state,
)
from needle_device_driver.cia402.drive_machine import DriveMachine
from needle_device_driver.cia402.drive_monitor import DriveMonitor, Feedback
from needle_device_driver.cia402.drive_settings import HERE, INDEX_PULSE, DriveSettings
from needle_device_driver.link import objects as od
from needle_device_driver.link.error_codes import HEARTBEAT_LOST, describe_error
from needle_device_driver.rules import Rule

Fault = tuple[Rule, str]

# Speed bound: this factor times the commanded speed, plus a margin in [m/s] or [rad/s].
_FACTOR = 1.5
_MARGINS = {"m": 5e-4, "rad": 0.1}
# Number of consecutive cycles above the bound that are a fault. A single one is not: a drive that
# sets its position to 0 at home causes one.
_MAX_FAST_CYCLES = 2
# Time constant of a motor that lags behind its set-points [s].
_LONGEST_LAG = 0.2

# A drive may report that it attained the previous homing. If the new one ends within a cycle, where
# the axis stands or at the edge of its switch, no change shows. So it counts as ended after this
# number of cycles at its home: for a homing where it stands, and for one to a switch.
_CYCLES_HERE, _CYCLES_AT_SWITCH = 5, 25
# An axis searches for its home over this share of its travel.
_SEARCH = 1.2
# Methods that end at a limit switch: its direction in counts, its bit of the digital inputs.
_TOWARDS = {17: (-1, od.NEGATIVE_LIMIT_SWITCH), 18: (1, od.POSITIVE_LIMIT_SWITCH)}


class SpeedMonitor:
    """Rule `axis_speed`: compares the speed of an axis with its commanded speed.

    Parameters
    ----------
    settings : DriveSettings
        The drive of the axis.
    period : float
        Of the SYNC [s].

    Attributes
    ----------
    problem : str
        How the axis is too fast; empty: it is not.
    """

    def __init__(self, settings: DriveSettings, period: float) -> None:
        self._settings = settings
        self._period = period
        # The commanded speed decays no faster than the axis slows down.
        self._decay = math.exp(-period / max(settings.stop_time, _LONGEST_LAG))
        self.reset()

    def reset(self) -> None:
        """Restart without a commanded speed."""
        self._commanded = 0.0
        self._fast_cycles = 0
        self.problem = ""

    def command(self, speed: float) -> None:
        """Note the commanded speed of the next cycle [m/s or rad/s]."""
        self._commanded = max(self._commanded, speed)

    def check(self, before: Feedback, at: Feedback, *, powered: bool) -> bool:
        """Return whether the axis moved at an allowed speed between two answers.

        The elapsed time is the greatest of three counts of SYNC periods: SYNCs sent, answers
        received, and time between both answers. Answers may be lost or late, and after a late
        SYNC the axis has moved farther.
        """
        settings, commanded = self._settings, self._commanded
        periods = max(
            1,
            at.syncs - before.syncs,
            at.number - before.number,
            round((at.time - before.time) / self._period),
        )
        speed = abs(settings.position(at.position - before.position)) / (periods * self._period)
        bound = _FACTOR * commanded + _MARGINS[settings.unit]
        self._commanded *= self._decay
        is_fast = powered and speed > bound
        self._fast_cycles = self._fast_cycles + 1 if is_fast else 0
        if self._fast_cycles >= _MAX_FAST_CYCLES and not self.problem:
            self.problem = (
                f"moves at {settings.text(speed)}/s, limit {settings.text(bound)}/s at "
                f"{settings.text(commanded)}/s commanded"
            )
        return not is_fast


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
        Towards the switch [m/s or rad/s].
    has_inputs : bool
        Whether the drive reports its limit switches.

    Attributes
    ----------
    step : HomingStep
        Stage of the homing.
    problem : str
        Why it must not continue; empty: it may.
    """

    def __init__(self, settings: DriveSettings, speed: float, *, has_inputs: bool) -> None:
        self._settings = settings
        self.speed = speed
        method = settings.homing_method
        # An index pulse lies within one turn beyond the switch.
        turn = (method in INDEX_PULSE) * settings.counts_per_turn
        self._longest = _SEARCH * settings.travel + turn / settings.counts_per_unit
        self._towards, self._switch = _TOWARDS.get(method * has_inputs, (0, 0))
        self._travelled = self._cycles_at_home = 0
        self.problem = ""
        self._reports_previous = False
        self.step = HomingStep.PREPARING

    def update(self, at: Feedback, moved: int) -> None:
        """Handle the newest answer, and the motion since the one before [counts]."""
        attained = bool(at.statusword & HOMING_ATTAINED)
        ended = attained and bool(at.statusword & TARGET_REACHED)
        if self.step is HomingStep.PREPARING:
            if drive_state(at.statusword) is DriveState.OPERATION_ENABLED and (
                at.mode == Mode.HOMING
            ):
                self._reports_previous = attained
                self.step = HomingStep.RUNNING
            return
        if self.step is not HomingStep.RUNNING:
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
            here = self._settings.homing_method in HERE
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


def drive_fault(  # noqa: PLR0911 - each return is a fault
    monitor: DriveMonitor,
    machine: DriveMachine,
    speed: SpeedMonitor,
    homing: HomingRun | None,
    *,
    actuated: bool,
) -> Fault | None:
    """Return the first fault of a drive, with its rule.

    Parameters
    ----------
    monitor : DriveMonitor
        Frames from the drive.
    machine : DriveMachine
        State of the drive.
    speed : SpeedMonitor
        Speed of its axis.
    homing : HomingRun or None
        A homing under way.
    actuated : bool
        Whether the drive has a motor; otherwise it may be in any state.
    """
    if speed.problem:
        return Rule.AXIS_SPEED, speed.problem
    if monitor.rebooted:
        return Rule.DRIVE_REBOOT, "the drive rebooted; its home position is lost"
    code = monitor.emergency
    if code is not None:
        rule = Rule.DRIVE_WATCHDOG if code == HEARTBEAT_LOST else Rule.DRIVE_EMERGENCY
        return rule, f"the drive reports {describe_error(code)}"
    state = machine.state
    if actuated and state is not None and state in FAULTS:
        return Rule.DRIVE_EMERGENCY, f"the drive is in {state.name}"
    if monitor.left_operational:
        return Rule.DRIVE_REBOOT, "the drive left the operational state"
    if machine.problem:
        return Rule.ONE_FAULT_STOPS_BOTH, f"the drive {machine.problem}"
    if homing is not None and homing.problem:
        failed = homing.step is HomingStep.FAILED
        rule = Rule.ONE_FAULT_STOPS_BOTH if failed else Rule.HOMING_TIME
        return rule, f"the drive {homing.problem}"
    if machine.ready and machine.at.statusword & FOLLOWING_ERROR:
        return Rule.FOLLOWING_ERROR, "the drive reports a following error"
    return None
