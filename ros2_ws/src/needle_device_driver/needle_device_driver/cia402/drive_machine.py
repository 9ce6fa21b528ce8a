"""Leads a drive through its CiA 402 states to a goal, cycle by cycle."""

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
    TransitionWatch,
    drive_state,
    next_command,
)
from needle_device_driver.cia402.drive_monitor import Feedback

# In cycles: how long an axis must stand still to be at rest; when it is switched off although it
# does not; how much longer than its ramp a quick stop may last, and how long it is then looked at;
# how much longer a drive may take to begin it; when a change of state has failed; when a quick stop
# is left by way of switching off.
_REST = 3
LONGEST_REST = 50
_STOP_MARGIN = 2
_WINDOW = 5
_SLOWEST_BEGIN = 25
_LONGEST_SWITCHING = 100
_LONGEST_REENABLE = 10


class DriveMachine:
    """Wanted and told state of a drive, and the command in between.

    Parameters
    ----------
    rest_counts : int
        An axis that moves no further in a cycle stands still.
    period : float
        Of a cycle [s].
    stop_time : float
        How long a quick stop takes at most [s].
    at : Feedback
        What the drive said last.
    """

    def __init__(self, rest_counts: int, period: float, stop_time: float, at: Feedback) -> None:
        self._rest_counts = rest_counts
        self._period = period
        self._longest_stop = math.ceil(stop_time / period) + _STOP_MARGIN
        self._watch = TransitionWatch()
        self._goal = Goal.OFF
        self._cycles = 0
        self._via_off = False
        self._stopping = False
        self._still = 0
        self._in_stop = 0
        self._rested = True
        self._track: deque[int] = deque(maxlen=_WINDOW + 1)
        self._runs_on = False
        self._sent_mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self.mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self.at = at
        self.target = at.position
        self.trouble = ""

    @property
    def state(self) -> DriveState | None:
        """State that the drive told last; None: nothing that CiA 402 has."""
        return drive_state(self.at.statusword)

    @property
    def ready(self) -> bool:
        """Tell whether a set-point would be followed."""
        return (
            self._goal is Goal.ON
            and not self._stopping
            and self.state is DriveState.OPERATION_ENABLED
            and self.at.mode == self.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        )

    @property
    def powered(self) -> bool:
        """Tell whether the drive is on by the present order, stopped or not."""
        # One that is still on from before, on its way off or to another mode, is not.
        on = self.state in POWERED and self.at.mode == self.mode
        return self._goal is not Goal.OFF and (on or self._via_off)

    @property
    def let_go(self) -> bool:
        """Tell whether the drive is switched off while stopped, as the axis was blocked."""
        return self._goal is Goal.STOPPED and self._via_off

    @property
    def unstopped(self) -> str:
        """State of a drive that should have stopped and switched off long ago; empty: it did."""
        powered = self.state in (*POWERED, DriveState.FAULT_REACTION_ACTIVE)
        late = self._cycles > self._longest_stop + _WINDOW
        # A hand may move an axis that has come to rest without power.
        moving = late and self._goes_on and (powered or not self._rested)
        told = ["powered"] * (powered and self._cycles > LONGEST_REST) + ["moving"] * moving
        return f"still {' and '.join(told)}" if told and self._goal is Goal.OFF else ""

    @property
    def switching(self) -> bool:
        """Tell whether the drive is on its way to the goal."""
        if self._goal is Goal.ON:
            return not self.ready
        if self._goal is Goal.STOPPED:
            return self.state is DriveState.OPERATION_ENABLED
        return self.state in POWERED

    def want(self, goal: Goal) -> None:
        """Set the goal."""
        if goal is not self._goal:
            # An axis that was let go of is on its way, it has not lost its power.
            self._via_off = self.let_go and goal is Goal.ON
            self._goal = goal
            self._cycles = 0
            self._rested = False

    def stop(self) -> None:
        """Want a stop; until the drive has said that it took it, nothing else is ordered."""
        if self._goal is not Goal.OFF:
            self.want(Goal.STOPPED)
        self._stopping = True

    def begin_anew(self, at: Feedback) -> None:
        """Forget what was, after a set-up or reset: the drive shall be off."""
        self._watch = TransitionWatch()
        self.want(Goal.OFF)
        self._stopping = False
        self._still = 0
        self._runs_on = False
        self.at = at
        self.target = at.position
        self.trouble = ""

    def next_order(self) -> tuple[DriveCommand, Mode]:
        """Return the command and the mode to send now."""
        command = DriveCommand.DISABLE_VOLTAGE if self._runs_on else self._next_command()
        self._watch.sent(command)
        # The mode of a powered drive stays: its set-point may be of another mode's making.
        if self.state not in POWERED:
            self._sent_mode = self.mode
        return command, self._sent_mode

    def update(self, at: Feedback) -> None:
        """Take what the drive says now; `trouble` has what is wrong with it."""
        still = abs(at.position - self.at.position) <= self._rest_counts
        self._rested = self._rested or self._still >= _REST
        self._track.append(at.position)
        self._still = self._still + 1 if still else 0
        self.at = at
        state = self.state
        if state is None:
            self._complain(f"says 0x{at.statusword:04X}, no statusword of CiA 402")
            return
        self._complain(self._watch.unexplained(state))
        follows = at.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        if self._stopping or not (follows and state is DriveState.OPERATION_ENABLED):
            # Whatever switches on or changes mode begins where the axis stands.
            self.target = at.position
        self._stopping = self._stopping and state is DriveState.OPERATION_ENABLED
        self._cycles += 1
        self._watch_stop(state)
        self._watch_switching(state)

    @property
    def _goes_on(self) -> bool:
        """Tell whether the axis leaves its place; jitter around it does not count."""
        track = self._track
        return len(track) > _WINDOW and abs(track[-1] - track[0]) > _WINDOW * self._rest_counts

    def _watch_stop(self, state: DriveState) -> None:
        """Switch off a drive that runs on after the order to stop, whatever it says."""
        if self._goal is Goal.ON or state not in POWERED:
            self._in_stop = 0
            return
        self._in_stop += 1
        longest = self._longest_stop + _WINDOW
        if state is not DriveState.QUICK_STOP_ACTIVE:
            longest += _SLOWEST_BEGIN
        if self._in_stop >= longest and self._goes_on:
            self._runs_on = True
            way = abs(self._track[-1] - self._track[0])
            what = "in its quick stop" if state is DriveState.QUICK_STOP_ACTIVE else "when stopped"
            self._complain(
                f"runs on {what} ({way} counts in {_WINDOW * self._period:g} s) and is switched "
                "off: its ramp 0x6085, the ramp's unit"
            )

    def _watch_switching(self, state: DriveState) -> None:
        homing = self.mode is Mode.HOMING and self.at.mode == Mode.HOMING
        if self.ready or (homing and state is DriveState.OPERATION_ENABLED):
            self._cycles = 0
            self._via_off = False
            return
        if (
            self._goal is Goal.ON
            and state is DriveState.QUICK_STOP_ACTIVE
            and self._cycles > _LONGEST_REENABLE + _REST
            and self._still > _REST
        ):
            # Transition 16 is optional: where it is lacking, through SWITCH ON DISABLED.
            self._via_off = True
        if (
            self._goal is Goal.STOPPED
            and self._still >= _REST
            and abs(self.at.following_error) > self._rest_counts
        ):
            # It was blocked, and its drive would pull it on when it comes free.
            self._via_off = True
        if self.switching and state not in FAULTS and self._cycles > _LONGEST_SWITCHING:
            self._runs_on = self._runs_on or self._goal is not Goal.ON
            self._complain(
                f"is not {self._goal.value} after {_LONGEST_SWITCHING * self._period:g} s: "
                f"{state.name}, mode {self.at.mode}"
                + ("" if self.at.statusword & REMOTE else ", not under the bus's control (bit 9)")
            )

    def _next_command(self) -> DriveCommand:
        state = self.state
        if self._stopping:
            return DriveCommand.QUICK_STOP
        if self.let_go or (self._via_off and state is DriveState.QUICK_STOP_ACTIVE):
            return DriveCommand.DISABLE_VOLTAGE
        if self._goal is not Goal.ON:
            at_rest = self._still >= _REST or self._cycles > LONGEST_REST
            return next_command(self._goal, state, at_rest=at_rest)
        at_rest = self._still >= _REST
        if self.at.mode != self.mode:
            if state in POWERED:
                return next_command(Goal.OFF, state, at_rest=at_rest)
            if state is DriveState.SWITCHED_ON:
                return DriveCommand.SWITCH_ON
        return next_command(Goal.ON, state, at_rest=at_rest)

    def _complain(self, text: str) -> None:
        self.trouble = self.trouble or text
