"""The device's state, its axes and what moves them: every way from one state to another."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from needle_device_driver.axes.axis import Axis, AxisError
from needle_device_driver.axes.axis_pair import AxisPair, PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.procedure import Procedure, side_by_side
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.homing_times import HomingTimes
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.motion_run import MotionRun, axes_problem
from needle_device_driver.supervisor.reports import REPLACED, SUCCEEDED, Event, Notice, StepResult
from needle_device_driver.supervisor.retraction_bound import RetractionBound
from needle_device_driver.supervisor.states import Activity, State, Trigger, next_state

_WATCHED = (State.DISABLED, State.HOLDING, State.MOVING)


class DeviceCore:
    """Carries out what the motion supervisor has allowed, and stops what must not go on.

    Parameters
    ----------
    axes : AxisPair
        The two axes.
    limits : SafetyLimits
        The bounds of the rules.
    feedback_delay : int
        How many cycles after its order a set-point shows in the axes' snapshots.
    on_stop : callable
        Called whenever a fault or emergency stop ends everything.

    Attributes
    ----------
    state, activity : State, Activity
        What the device may do, and what moves; only its own methods change this and what follows.
    configured : bool
        Whether the axes are set up.
    fault, reason : str
        Why the state is FAULT or ESTOPPED; why the device last stopped, refused or waits.
    watchdog_trips : int
        How often a hold, tip or reply was too old.
    snapshot : PairSnapshot or None
        The axes' newest replies.
    step_stamp_ns : int or None
        Stamp of the step under way [ns].
    stops : int
        How many faults and emergency stops there were, also while there was one already.
    """

    def __init__(
        self,
        axes: AxisPair,
        limits: SafetyLimits,
        *,
        feedback_delay: int,
        on_stop: Callable[[], None],
    ) -> None:
        self._axes = axes
        self._limits = limits
        self._feedback_delay = feedback_delay
        self._on_stop = on_stop
        self._retraction_bound = RetractionBound(limits.max_depth)
        self._run: MotionRun | None = None
        self._homing_times = HomingTimes(limits)
        self._seen_powered = False
        self._pushed_too_fast = False
        self._let_go = self._unstopped = ""
        self._events: list[Event] = []
        self.state = State.UNCONFIGURED
        self.activity = Activity.NONE
        self.configured = False
        self.fault = ""
        self.reason = ""
        self.watchdog_trips = self.stops = 0
        self.snapshot: PairSnapshot | None = None
        self.step_stamp_ns: int | None = None

    # ---- what is told -------------------------------------------------------------------------

    @property
    def moves_with_hold(self) -> bool:
        """Tell whether something is under way that the hold lets go on."""
        return self.activity in (Activity.STEP, Activity.RETRACTION)

    @property
    def way_out(self) -> float:
        """Longest way that the needle may be drawn out [m]; none without a snapshot."""
        if self.snapshot is None:
            return 0.0
        insertion = self.snapshot.insertion
        return insertion.position - self._retraction_bound.target(insertion)

    @property
    def fault_now(self) -> str:
        """Reason of FAULT or ESTOPPED, and the axes that did not stop."""
        return f"{self.fault}; {self._unstopped}" if self._unstopped else self.fault

    @property
    def rotation_owed(self) -> float:
        """Lag of the rotation behind a needle that is pushed too fast for it [rad]."""
        if self._run is None or self.snapshot is None:
            return 0.0
        owed = self._run.rotation_owed(self.snapshot)
        return owed if owed > self._limits.rotation_following_error else 0.0

    def notice(self, text: str, rule: Rule | None = None) -> None:
        """Tell a person something once."""
        self._events.append(Notice(text, rule))

    def answer(self, stamp_ns: int, outcome: str) -> None:
        """Tell the end of a command."""
        self._events.append(StepResult(stamp_ns, outcome))

    def explain(self, reason: str) -> None:
        """Take why the device last stopped, refused or waits."""
        self.reason = reason

    def count_watchdog_trip(self) -> None:
        """Count a hold, tip or reply that was too old."""
        self.watchdog_trips += 1

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events

    # ---- orders to both axes ------------------------------------------------------------------

    def order(self, order: Callable[[Axis], None]) -> str:
        """Give both axes an order; a refusal is a fault, and its text is returned."""
        try:
            self._axes.each(order)
        except AxisError as error:
            self.fail(str(error), error.rule)
            return str(error)
        return ""

    def power_on(self) -> str:
        """Switch both axes on, where they stand; return what went wrong."""
        self._seen_powered = False
        return self.order(lambda axis: axis.power(True))

    def power_off(self) -> str:
        """Switch both axes off; return what went wrong."""
        return self.order(lambda axis: axis.power(False))

    # ---- ways from state to state -------------------------------------------------------------

    def go(self, trigger: Trigger, reason: str) -> None:
        """Change the state."""
        self.state = next_state(self.state, trigger)
        self.reason = reason

    def configure(self) -> Procedure[str]:
        """Set the axes up; return what went wrong."""
        try:
            yield from self._axes.side_by_side(lambda axis: axis.configure())
        except AxisError as error:
            # The other axis may be set up, and would wait for a computer that says no more.
            with contextlib.suppress(AxisError):
                yield from self._axes.close()
            self.fail(str(error), error.rule)
            return str(error)
        self.configured = True
        self.go(Trigger.CONFIGURE, "configured")
        return ""

    def let_go(self) -> Procedure[bool]:
        """Switch the axes off and let go of them; return whether that was from DISABLED."""
        if self.configured:
            self.configured = False
            try:
                yield from self._axes.close()
            except AxisError as error:
                self.fail(str(error), error.rule)
        if self.state is not State.DISABLED:
            return False
        self.snapshot = None
        self.go(Trigger.DECONFIGURE, "deconfigured")
        return True

    def reset(self, now: float) -> Procedure[str]:
        """Leave a fault or emergency stop, the axes off; return what is still wrong."""
        trigger, reason = Trigger.RESET_UNCONFIGURED, "reset"
        if self.configured:
            try:
                yield from self._axes.side_by_side(lambda axis: axis.reset())
                self._axes.each(lambda axis: axis.power(False))
            except AxisError as error:
                return str(error)
            problem = axes_problem(
                self.poll(now), now, self._limits, powered_wanted=False, homed_wanted=False
            )
            if problem is not None:
                return problem[1]
            trigger, reason = Trigger.RESET, "reset; enable to go on"
        self.fault = self._unstopped = ""
        self.go(trigger, reason)
        return ""

    def start(self, activity: Activity, legs: Sequence[Leg], stamp_ns: int | None = None) -> None:
        """Begin a step or retraction from where the axes are; the stamp is the command's [ns]."""
        assert self.snapshot is not None
        self.activity, self.step_stamp_ns = activity, stamp_ns
        self._run = MotionRun(
            activity,
            legs,
            self.snapshot,
            self._limits,
            feedback_delay=self._feedback_delay,
            pushed=not self._axes.insertion.actuated,
        )
        self.go(Trigger.MOTION_START, "")
        if not self.snapshot.ready:
            # After a stop, an axis is made ready by the order to move, never by itself.
            self.order(lambda axis: axis.power(True))

    def replace(self, legs: Sequence[Leg], stamp_ns: int) -> None:
        """Go another way from where the axes were last told to be; the command before is answered.

        Parameters
        ----------
        legs : sequence of Leg
            The way.
        stamp_ns : int
            Of the command that takes the place of the one under way [ns].
        """
        assert self._run is not None
        assert self.snapshot is not None
        assert self.step_stamp_ns is not None
        self.answer(self.step_stamp_ns, REPLACED)
        self._run.replace(legs, self.snapshot)
        self.step_stamp_ns = stamp_ns

    def start_homing(self) -> Procedure[str]:
        """Begin to look for both home switches; return what went wrong."""
        if error := self.power_on():
            return error
        insertion = self._axes.insertion.home(self._limits.homing_speed)
        rotation = self._axes.rotation.home(self._limits.homing_rotation_rate)
        try:
            yield from side_by_side(insertion, rotation)
        except AxisError as refusal:
            self.fail(str(refusal), refusal.rule)
            return str(refusal)
        except GeneratorExit:
            # Called off: the axes stay where they are, without power.
            self.power_off()
            raise
        self._homing_times = HomingTimes(self._limits)
        self.activity = Activity.HOMING
        self.go(Trigger.HOMING_START, "homing")
        return ""

    def end_motion(self, outcome: str, *, stop: bool) -> None:
        """End what is under way, whatever it is; a step's outcome is told."""
        if stop:
            try:
                self._axes.each(lambda axis: axis.stop())
            except AxisError as error:
                self.notice(str(error), error.rule)
        if self.step_stamp_ns is not None:
            self.answer(self.step_stamp_ns, outcome)
        self.activity = Activity.NONE
        self._run = self.step_stamp_ns = None

    def abort(self, reason: str) -> None:
        """Stop what is under way."""
        homing = self.activity is Activity.HOMING
        self.end_motion(f"aborted: {reason}", stop=True)
        self.go(Trigger.HOMING_END if homing else Trigger.MOTION_END, reason)
        if homing:
            self.power_off()

    def fail(self, reason: str, rule: Rule | None = None) -> None:
        """Stop both axes for a fault; it takes a reset to go on."""
        self.stops += 1
        if self.state not in (State.FAULT, State.ESTOPPED):
            self._stop_for_good(Trigger.FAIL, reason, rule)

    def emergency_stop(self) -> None:
        """Stop both axes, whatever the state."""
        self.stops += 1
        if self.state is not State.ESTOPPED:
            self._stop_for_good(Trigger.ESTOP, "emergency stop", Rule.ESTOP_LATCHES)

    def _stop_for_good(self, trigger: Trigger, reason: str, rule: Rule | None) -> None:
        self._on_stop()
        self.fault = reason
        self.end_motion(f"aborted: {reason}", stop=True)
        self.go(trigger, reason)
        self._events.append(Notice(reason, rule, fault=True))
        try:
            # A drive that keeps its power pulls a blocked axis on as soon as it comes free.
            self._axes.each(lambda axis: axis.power(False))
        except AxisError as error:
            self.notice(str(error), error.rule)

    # ---- the cycle ----------------------------------------------------------------------------

    def drive_homing(self, period: float) -> None:
        """Let `period` [s] of a homing go by."""
        assert self.snapshot is not None
        if text := self._homing_times.count(self.snapshot, period):
            self.fail(text, Rule.HOMING_TIME)

    def drive(self, period: float, speed_scale: float, now: float) -> None:
        """Order the set-points of the next `period` [s] of what is under way."""
        if self._run is None:
            return
        at = self.poll(now)
        if not at.answered:
            # Nothing is sent on that may have lost its way: silence stops, then is a fault.
            return
        problem = self._run.problem(at)
        if problem is not None:
            self.fail(problem[1], problem[0])
            return
        set_point = self._run.advance(at, period, speed_scale)
        if set_point is None:
            return
        self._watch_pushing()
        try:
            if self._axes.insertion.actuated:
                self._axes.insertion.start_move(set_point.insertion, set_point.insertion_speed)
            if self.activity is Activity.STEP:
                self._axes.rotation.start_move(set_point.rotation, set_point.rotation_speed)
        except AxisError as error:
            self.fail(str(error), error.rule)

    def _watch_pushing(self) -> None:
        owed, told = self.rotation_owed, self._pushed_too_fast
        self._pushed_too_fast = owed > 0.0
        if owed > 0.0 and not told:
            text = f"pushed too fast: the rotation is {owed:.2f} rad behind, push more slowly"
            self.explain(text)
            self.notice(text, Rule.MAX_ROTATION_RATE)

    def _watch_letting_go(self, at: PairSnapshot) -> None:
        told, self._let_go = self._let_go, at.let_go
        if at.let_go and not told:
            text = f"{at.let_go}: blocked when it was stopped; switched off until the next motion"
            self.explain(text)
            self.notice(text, Rule.FOLLOWING_ERROR)

    def poll(self, now: float) -> PairSnapshot:
        """Read the axes."""
        self.snapshot = self._axes.poll(now)
        self._retraction_bound.note(self.snapshot.insertion)
        return self.snapshot

    def watch_axes(self, now: float) -> None:
        """Read the axes and stop both for what is wrong with one."""
        at = self.poll(now)
        if self.state not in _WATCHED:
            # In FAULT the silence may be the fault itself.
            oldest = now - self._limits.reply_age_limit if self.state is State.ESTOPPED else 0.0
            told, self._unstopped = self._unstopped, at.unstopped(oldest)
            if self._unstopped not in ("", told):
                self._events.append(Notice(self._unstopped, Rule.QUICK_STOP, fault=True))
            return
        on = self.state is not State.DISABLED
        problem = axes_problem(
            at,
            now,
            self._limits,
            # Drives take a while to switch on: only a loss counts.
            powered_wanted=on and self._seen_powered,
            homed_wanted=self.activity is Activity.STEP,
        )
        self._seen_powered = on and (self._seen_powered or at.powered)
        self._watch_letting_go(at)
        if problem is not None:
            self.watchdog_trips += problem[0] is Rule.REPLY_AGE
            self.fail(problem[1], problem[0])

    def end_what_has_ended(self) -> None:
        """End a homing, step or retraction that has arrived."""
        at = self.snapshot
        if at is None:
            return
        if self.activity is Activity.HOMING:
            if at.homed and not (at.insertion.moving or at.rotation.moving):
                self.end_motion("", stop=False)
                self.go(Trigger.HOMING_END, "homed")
                self.power_off()
        elif self._run is not None and self._run.arrived(at):
            # At the switch a retraction may have a target still.
            self.end_motion(SUCCEEDED, stop=self.activity is Activity.RETRACTION)
            self.go(Trigger.MOTION_END, "")
