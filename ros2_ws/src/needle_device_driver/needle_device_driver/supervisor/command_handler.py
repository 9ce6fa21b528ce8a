"""Handling of commands: start, replace a path, or refuse."""

from __future__ import annotations

from needle_core.messages import Trajectory
from needle_device_driver.axes.axis import PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import (
    CommandContext,
    Refusal,
    check_command,
    describe_lead,
    is_path,
)
from needle_device_driver.supervisor.command_stamps import CommandStamps
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.motion_run import INNER_SWITCH
from needle_device_driver.supervisor.reports import SUCCEEDED
from needle_device_driver.supervisor.states import Activity, State


class CommandHandler:
    """Handles commands for a device; `now` is the steady time [s] in every method.

    Parameters
    ----------
    core : DeviceCore
        Executes accepted commands.
    hold : Hold
        The hold to run.
    limits : SafetyLimits
        The bounds of the rules.

    Attributes
    ----------
    stamps : CommandStamps
        Ages of stamps, and those that were used.
    refused : int
        Number of refused commands.
    newest_ns : int
        Stamp of the newest command, accepted or refused [ns]; 0: none yet.
    """

    def __init__(self, core: DeviceCore, hold: Hold, limits: SafetyLimits) -> None:
        self._core = core
        self._hold = hold
        self._limits = limits
        self._on_path = False
        self.stamps = CommandStamps(2.0 * limits.tip_age_limit)
        self.refused = 0
        self.newest_ns = 0

    def submit(self, command: Trajectory, now: float, publishers: int) -> bool:
        """Handle an unchecked command; return whether it starts a motion."""
        self.newest_ns = command.stamp_ns
        legs = self._check(command, now, publishers)
        if isinstance(legs, Refusal):
            self._refuse(command, legs)
            return False
        self.stamps.accept(command.stamp_ns)
        if not legs:
            # An earlier path has reached the end already, or is within tolerance of it.
            self._core.report_result(command.stamp_ns, SUCCEEDED)
            return False
        self._on_path = is_path(command)
        if self._core.activity is Activity.STEP:
            self._core.replace(legs, command.stamp_ns)
        else:
            self._core.start(Activity.STEP, legs, command.stamp_ns)
        return True

    def check_path_age(self, now: float) -> None:
        """Abort a path whose tip is too old: the needle position is no longer known."""
        stamp_ns = self._core.step_stamp_ns
        if not self._on_path or stamp_ns is None:
            return
        age, limit = self.stamps.age(stamp_ns, now), self._limits.tip_age_limit
        # The age is negative if ROS time was set back; the tip would never get too old.
        if not 0.0 <= age <= limit:
            self._core.watchdog_trips += 1
            old = f"{age:.3f} s old, limit {limit:g} s"
            text = f"the tip behind the path is {describe_lead(age) if age < 0.0 else old}"
            self._core.notice(text, Rule.TIP_AGE)
            self._core.abort(text)

    def _check(self, command: Trajectory, now: float, publishers: int) -> tuple[Leg, ...] | Refusal:
        at = self._check_device(command, now)
        if isinstance(at, Refusal):
            return at
        context = CommandContext(
            insertion=at.insertion.set_point,
            rotation=at.rotation.set_point,
            homed=at.homed,
            not_new=self.stamps.why_not_new(command.stamp_ns),
            tip_age=self.stamps.age(command.stamp_ns, now),
            publishers=publishers,
        )
        return check_command(command, context, self._limits)

    def _check_device(self, command: Trajectory, now: float) -> PairSnapshot | Refusal:
        replaces = is_path(command) and self._on_path and self._core.activity is Activity.STEP
        if self._core.state is not State.HOLDING and not replaces:
            state = self._core.state.value
            return Refusal(Rule.COMMAND_STATE, f"the device is {state}, not {State.HOLDING.value}")
        if self._hold.owner is None:
            return Refusal(Rule.HOLD_TO_RUN, "the hold is not pressed")
        # Read the axes again: one may have stopped since the last cycle.
        at = self._core.poll(now)
        if at.age(now) > self._limits.reply_age_limit:
            return Refusal(Rule.REPLY_AGE, "no fresh reply from the axes")
        if not at.powered:
            return Refusal(Rule.COMMAND_STATE, "the axes are not powered yet")
        if at.insertion.at_inner_switch:
            return Refusal(Rule.INNER_LIMIT_SWITCH, f"{INNER_SWITCH}: retract")
        return at

    def _refuse(self, command: Trajectory, refusal: Refusal) -> None:
        self.refused += 1
        if refusal.rule is Rule.TIP_AGE:
            self._core.watchdog_trips += 1
        self._core.explain(f"command refused: {refusal.reason}", refusal.rule)
        # A result with the stamp of the running step would mean that the step has ended.
        if command.stamp_ns != self._core.step_stamp_ns:
            self._core.report_result(command.stamp_ns, f"aborted: {refusal.reason}")
