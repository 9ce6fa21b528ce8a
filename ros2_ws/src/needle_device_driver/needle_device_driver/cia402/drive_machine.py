"""Control of a drive through its CiA 402 states to a goal state, cycle by cycle."""

from __future__ import annotations

import math
from collections import deque

from needle_device_driver.cia402.cia402 import (
    FAULTS,
    POWERED,
    REMOTE,
    DriveCommand,
    DriveState,
    Goal,
    Mode,
    TransitionMonitor,
    drive_state,
    next_command,
)
from needle_device_driver.cia402.drive_monitor import Feedback

# All in cycles. An axis is at rest after standing still for this time.
_REST = 3
# A stopped axis is switched off after this time even if it is not at rest.
MAX_REST = 50
# A quick stop may last its ramp plus this margin; then the axis is observed for a window.
_STOP_MARGIN = 2
_WINDOW = 5
# A drive may take this additional time to begin a quick stop.
_MAX_STOP_DELAY = 25
# A change of state that takes longer has failed.
_MAX_SWITCHING = 100
# A drive that does not leave its quick stop in this time at rest is switched off and on again.
_MAX_REENABLE = 10


class DriveMachine:
    """State of a drive, its goal, and the next command.

    Parameters
    ----------
    rest_counts : int
        Largest motion per cycle of an axis at rest [counts].
    period : float
        Period of a cycle [s].
    stop_time : float
        Longest time of a quick stop [s].
    at : Feedback
        Newest process data of the drive.

    Attributes
    ----------
    mode : Mode
        Requested mode of operation.
    at : Feedback
        Newest process data of the drive.
    target : int
        Set-point of the drive [counts].
    problem : str
        Problem with the drive; empty: none.
    """

    def __init__(self, rest_counts: int, period: float, stop_time: float, at: Feedback) -> None:
        self._rest_counts = rest_counts
        self._period = period
        self._max_stop = math.ceil(stop_time / period) + _STOP_MARGIN
        self._goal = Goal.OFF
        self._cycles = 0
        self._switched_off_temporarily = False
        self._cycles_in_stop = 0
        self._rested = True
        self._track: deque[int] = deque(maxlen=_WINDOW + 1)
        self._sent_mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self.mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self.restart(at)

    @property
    def state(self) -> DriveState | None:
        """State of the drive; None: its statusword is not one of CiA 402."""
        return drive_state(self.at.statusword)

    @property
    def ready(self) -> bool:
        """Whether the drive would follow a set-point."""
        return (
            self._goal is Goal.ON
            and not self._stopping
            and self.state is DriveState.OPERATION_ENABLED
            and self.at.mode == self.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        )

    @property
    def powered(self) -> bool:
        """Whether the drive is on because of the present order, moving or stopped."""
        # Excludes a drive that is still on, or in another mode.
        on = self.state in POWERED and self.at.mode == self.mode
        return self._goal is not Goal.OFF and (on or self._switched_off_temporarily)

    @property
    def released_after_block(self) -> bool:
        """Whether the drive is switched off because the axis was stopped while blocked."""
        return self._goal is Goal.STOPPED and self._switched_off_temporarily

    @property
    def stop_failure(self) -> str:
        """Description of a drive that moves or has power long after goal OFF; empty: none."""
        powered = self.state in (*POWERED, DriveState.FAULT_REACTION_ACTIVE)
        late = self._cycles > self._max_stop + _WINDOW
        # An axis that has come to rest without power may be moved by hand.
        moving = late and self._keeps_moving and (powered or not self._rested)
        failures = ["powered"] * (powered and self._cycles > MAX_REST) + ["moving"] * moving
        return f"still {' and '.join(failures)}" if failures and self._goal is Goal.OFF else ""

    @property
    def switching(self) -> bool:
        """Whether the drive has not reached its goal yet."""
        if self._goal is Goal.ON:
            return not self.ready
        if self._goal is Goal.STOPPED:
            return self.state is DriveState.OPERATION_ENABLED
        return self.state in POWERED

    def set_goal(self, goal: Goal) -> None:
        """Set the goal."""
        if goal is not self._goal:
            # A released axis still counts as powered while it is switched on again.
            self._switched_off_temporarily = self.released_after_block and goal is Goal.ON
            self._goal = goal
            self._cycles = 0
            self._rested = False

    def stop(self) -> None:
        """Request a quick stop; no other command is sent until the drive confirms it."""
        if self._goal is not Goal.OFF:
            self.set_goal(Goal.STOPPED)
        self._stopping = True

    def restart(self, at: Feedback) -> None:
        """Restart after a set-up or reset, with the goal OFF."""
        self._transitions = TransitionMonitor()
        self.set_goal(Goal.OFF)
        self._stopping = False
        self._still_cycles = 0
        self._ignores_stop = False
        self.at = at
        self.target = at.position
        self.problem = ""

    def next_order(self) -> tuple[DriveCommand, Mode]:
        """Return the command and the mode to send now."""
        command = DriveCommand.DISABLE_VOLTAGE if self._ignores_stop else self._next_command()
        self._transitions.note_command(command)
        # A powered drive keeps its mode: its set-point may belong to that mode.
        if self.state not in POWERED:
            self._sent_mode = self.mode
        return command, self._sent_mode

    def update(self, at: Feedback) -> None:
        """Handle the newest process data."""
        still = abs(at.position - self.at.position) <= self._rest_counts
        self._rested = self._rested or self._still_cycles >= _REST
        self._track.append(at.position)
        self._still_cycles = self._still_cycles + 1 if still else 0
        self.at = at
        state = self.state
        if state is None:
            self._set_problem(f"reports 0x{at.statusword:04X}, not a CiA 402 statusword")
            return
        self._set_problem(self._transitions.unexplained(state))
        follows = at.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        if self._stopping or not (follows and state is DriveState.OPERATION_ENABLED):
            # A drive that switches on or changes its mode must start where the axis stands.
            self.target = at.position
        self._stopping = self._stopping and state is DriveState.OPERATION_ENABLED
        self._cycles += 1
        self._check_stop(state)
        self._check_switching(state)

    @property
    def _keeps_moving(self) -> bool:
        """Whether the axis keeps moving; jitter around a fixed position does not count."""
        track = self._track
        return len(track) > _WINDOW and abs(track[-1] - track[0]) > _WINDOW * self._rest_counts

    def _check_stop(self, state: DriveState) -> None:
        """Switch off a drive that keeps moving after the order to stop."""
        if self._goal is Goal.ON or state not in POWERED:
            self._cycles_in_stop = 0
            return
        self._cycles_in_stop += 1
        longest = self._max_stop + _WINDOW
        if state is not DriveState.QUICK_STOP_ACTIVE:
            longest += _MAX_STOP_DELAY
        if self._cycles_in_stop >= longest and self._keeps_moving:
            self._ignores_stop = True
            distance = abs(self._track[-1] - self._track[0])
            when = "in its quick stop" if state is DriveState.QUICK_STOP_ACTIVE else "when stopped"
            self._set_problem(
                f"keeps moving {when} ({distance} counts in {_WINDOW * self._period:g} s) and is "
                "switched off: check the ramp 0x6085 and its unit"
            )

    def _check_switching(self, state: DriveState) -> None:
        homing = self.mode is Mode.HOMING and self.at.mode == Mode.HOMING
        if self.ready or (homing and state is DriveState.OPERATION_ENABLED):
            self._cycles = 0
            self._switched_off_temporarily = False
            return
        if (
            self._goal is Goal.ON
            and state is DriveState.QUICK_STOP_ACTIVE
            and min(self._cycles, self._still_cycles) > _MAX_REENABLE
        ):
            # Transition 16 is optional: without it, go through SWITCH ON DISABLED.
            self._switched_off_temporarily = True
        if (
            self._goal is Goal.STOPPED
            and self._still_cycles >= _REST
            and abs(self.at.following_error) > self._rest_counts
        ):
            # The axis is blocked: the drive would move it as soon as it is freed.
            self._switched_off_temporarily = True
        if self.switching and state not in FAULTS and self._cycles > _MAX_SWITCHING:
            self._ignores_stop = self._ignores_stop or self._goal is not Goal.ON
            self._set_problem(
                f"is not {self._goal.value} after {_MAX_SWITCHING * self._period:g} s: "
                f"{state.name}, mode {self.at.mode}"
                + ("" if self.at.statusword & REMOTE else ", not under remote control (bit 9)")
            )

    def _next_command(self) -> DriveCommand:
        state = self.state
        if self._stopping:
            return DriveCommand.QUICK_STOP
        if self.released_after_block or (
            self._switched_off_temporarily and state is DriveState.QUICK_STOP_ACTIVE
        ):
            return DriveCommand.DISABLE_VOLTAGE
        at_rest = self._still_cycles >= _REST
        if self._goal is not Goal.ON:
            return next_command(self._goal, state, at_rest=at_rest or self._cycles > MAX_REST)
        if self.at.mode != self.mode:
            if state in POWERED:
                return next_command(Goal.OFF, state, at_rest=at_rest)
            if state is DriveState.SWITCHED_ON:
                return DriveCommand.SWITCH_ON
        return next_command(Goal.ON, state, at_rest=at_rest)

    def _set_problem(self, text: str) -> None:
        self.problem = self.problem or text
