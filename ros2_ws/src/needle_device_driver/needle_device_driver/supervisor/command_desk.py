"""Fate of a command: it starts, replaces a path, waits for its time, or is refused."""

from __future__ import annotations

from needle_device_driver.axes.axis_pair import PairSnapshot
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import (
    Command,
    CommandContext,
    Refusal,
    check_command,
    clocks_differ,
)
from needle_device_driver.supervisor.command_stamps import CommandStamps
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.motion_run import INNER_SWITCH
from needle_device_driver.supervisor.reports import SUCCEEDED
from needle_device_driver.supervisor.states import Activity, State


class CommandDesk:
    """Takes commands for a device; `now` is everywhere the steady clock [s].

    Parameters
    ----------
    core : DeviceCore
        Carries out what is allowed.
    hold : Hold
        Whose press counts.
    limits : SafetyLimits
        The bounds of the rules.

    Attributes
    ----------
    refused : int
        Commands that were refused.
    newest_ns : int
        Stamp of the newest command, whatever became of it [ns]; 0: none yet.
    """

    def __init__(
        self,
        core: DeviceCore,
        hold: Hold,
        limits: SafetyLimits,
    ) -> None:
        self._core = core
        self._hold = hold
        self._limits = limits
        self._stamps = CommandStamps(2.0 * limits.tip_age_limit)
        self._on_path = False
        self.refused = 0
        self.newest_ns = 0

    def note_time(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns]."""
        self._stamps.note(ros_ns, now)

    def readmit(self) -> None:
        """Let in commands stamped after a time that went back."""
        self._stamps.readmit()

    def submit(self, command: Command, now: float, publishers: int) -> bool:
        """Take a command, nothing checked; return whether it moves the needle from now on."""
        self.newest_ns = command.stamp_ns
        return self._start(command, now, publishers)

    def watch_path(self, now: float) -> None:
        """End a path whose tip has become too old: nobody says any more where the needle is."""
        stamp_ns = self._core.step_stamp_ns
        if not self._on_path or stamp_ns is None:
            return
        age, limit = self._stamps.age(stamp_ns, now), self._limits.tip_age_limit
        # One from the future was taken when it was none: time was set back, and it would not age.
        if not 0.0 <= age <= limit:
            self._core.count_watchdog_trip()
            old = f"{age:.3f} s old, limit {limit:g} s"
            text = f"the tip behind the path is {clocks_differ(age) if age < 0.0 else old}"
            self._core.notice(text, Rule.TIP_AGE)
            self._core.abort(text)

    def _start(self, command: Command, now: float, publishers: int) -> bool:
        at = self._ready_for(command, now)
        if isinstance(at, Refusal):
            self._refuse(command, at)
            return False
        context = CommandContext(
            insertion=at.insertion.set_point,
            rotation=at.rotation.set_point,
            homed=at.homed,
            not_new=self._stamps.why_not_new(command.stamp_ns),
            tip_age=self._stamps.age(command.stamp_ns, now),
            publishers=publishers,
        )
        legs = check_command(command, context, self._limits)
        if isinstance(legs, Refusal):
            self._refuse(command, legs)
            return False
        self._stamps.use(command.stamp_ns)
        if not legs:
            # Another path has led there already, or is about to say so.
            self._core.answer(command.stamp_ns, SUCCEEDED)
            return False
        self._on_path = command.is_path
        if self._core.activity is Activity.STEP:
            self._core.replace(legs, command.stamp_ns)
        else:
            self._core.start(Activity.STEP, legs, command.stamp_ns)
        return True

    def _ready_for(self, command: Command, now: float) -> PairSnapshot | Refusal:
        replaces = command.is_path and self._on_path and self._core.activity is Activity.STEP
        if self._core.state is not State.HOLDING and not replaces:
            state = self._core.state.value
            return Refusal(Rule.COMMAND_STATE, f"the device is {state}, not {State.HOLDING.value}")
        if self._hold.owner is None:
            return Refusal(Rule.HOLD_TO_RUN, "nobody holds to run")
        # Not the last cycle's: a stop since then must be known.
        at = self._core.poll(now)
        if at.age(now) > self._limits.reply_age_limit:
            return Refusal(Rule.REPLY_AGE, "no fresh reply from the axes")
        if not at.powered:
            return Refusal(Rule.COMMAND_STATE, "the axes are not powered yet")
        if at.insertion.at_inner_switch:
            return Refusal(Rule.INNER_LIMIT_SWITCH, f"{INNER_SWITCH}: retract")
        return at

    def _refuse(self, command: Command, refusal: Refusal) -> None:
        self.refused += 1
        if refusal.rule is Rule.TIP_AGE:
            self._core.count_watchdog_trip()
        text = f"command refused: {refusal.reason}"
        self._core.explain(text)
        self._core.notice(text, refusal.rule)
        # The running step's own stamp would tell its sender that the step has ended.
        if command.stamp_ns != self._core.step_stamp_ns:
            self._core.answer(command.stamp_ns, f"aborted: {refusal.reason}")
