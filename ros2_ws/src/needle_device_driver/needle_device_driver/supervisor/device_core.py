"""State, axes and motion of the device."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from needle_core.messages import CommandResult
from needle_device_driver.axes.axis import Axis, AxisError, AxisPair, PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.procedure import Procedure, side_by_side
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.motion_run import (
    HomingTimes,
    MotionRun,
    RetractionBound,
    axes_problem,
)
from needle_device_driver.supervisor.reports import REPLACED, SUCCEEDED, Event, Notice
from needle_device_driver.supervisor.states import Activity, State, Trigger, next_state

_SUPERVISED = (State.DISABLED, State.HOLDING, State.MOVING)


class DeviceCore:
    """Executes the motions that the supervisor allows, and stops the axes on a fault.

    Parameters
    ----------
    axes : AxisPair
        The two axes.
    limits : SafetyLimits
        The bounds of the rules.
    feedback_delay : int
        Number of cycles until a set-point shows in the feedback.
    on_stop : callable
        Called on each fault and emergency stop.

    Attributes
    ----------
    state, activity : State, Activity
        State of the device, and its motion.
    configured : bool
        Whether the axes are set up.
    reason : str
        Reason why the device stopped, refused a request or waits.
    watchdog_trips : int
        Number of hold, tip and feedback time-outs.
    snapshot : PairSnapshot or None
        Newest feedback of the axes.
    step_stamp_ns : int or None
        Stamp of the step under way [ns].
    stops : int
        Number of faults and emergency stops, including those in FAULT and ESTOPPED.
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
        self._was_powered = False
        self._pushed_too_fast = False
        self._fault = self._released_after_block = self._stop_failures = ""
        self._events: list[Event] = []
        self.state = State.UNCONFIGURED
        self.activity = Activity.NONE
        self.configured = False
        self.reason = ""
        self.watchdog_trips = self.stops = 0
        self.snapshot: PairSnapshot | None = None
        self.step_stamp_ns: int | None = None

    # ---- reports ------------------------------------------------------------------------------

    @property
    def needs_hold(self) -> bool:
        """Whether the motion under way needs the hold."""
        return self.activity in (Activity.STEP, Activity.RETRACTION)

    @property
    def retraction_distance(self) -> float:
        """Longest allowed retraction [m]."""
        assert self.snapshot is not None
        insertion = self.snapshot.insertion
        return insertion.position - self._retraction_bound.target(insertion)

    @property
    def fault(self) -> str:
        """Reason for FAULT or ESTOPPED, with the axes that did not stop; otherwise empty."""
        return f"{self._fault}; {self._stop_failures}" if self._stop_failures else self._fault

    @property
    def rotation_lag(self) -> float:
        """Lag of the rotation behind a needle that is pushed too fast, otherwise 0 [rad]."""
        if self._run is None or self.snapshot is None:
            return 0.0
        lag = self._run.rotation_lag(self.snapshot)
        return lag if lag > self._limits.rotation_following_error else 0.0

    def notice(self, text: str, rule: Rule | None = None) -> None:
        """Add an event for the log."""
        self._events.append(Notice(text, rule))

    def explain(self, text: str, rule: Rule) -> None:
        """Set the reason, and add it as an event for the log."""
        self.reason = text
        self.notice(text, rule)

    def report_result(self, stamp_ns: int, outcome: str) -> None:
        """Report the outcome of a command."""
        self._events.append(CommandResult(stamp_ns, outcome))

    def pop_events(self) -> tuple[Event, ...]:
        """Return the events since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events

    # ---- orders to both axes ------------------------------------------------------------------

    def order(self, order: Callable[[Axis], None]) -> str:
        """Send an order to both axes; an error is a fault, and its text is returned."""
        try:
            self._axes.each(order)
        except AxisError as error:
            self.fail(str(error), error.rule)
            return str(error)
        return ""

    def power_on(self) -> str:
        """Switch both axes on without motion; return the error."""
        self._was_powered = False
        return self.order(lambda axis: axis.power(True))

    def power_off(self) -> str:
        """Switch both axes off; return the error."""
        return self.order(lambda axis: axis.power(False))

    # ---- transitions --------------------------------------------------------------------------

    def change_state(self, trigger: Trigger, reason: str) -> None:
        """Change the state."""
        self.state = next_state(self.state, trigger)
        self.reason = reason

    def configure(self) -> Procedure[str]:
        """Set the axes up; return the error."""
        try:
            yield from self._axes.side_by_side(lambda axis: axis.configure())
        except AxisError as error:
            # The watchdog of the other axis may be armed already, and no heartbeat follows.
            with contextlib.suppress(AxisError):
                yield from self._axes.close()
            self.fail(str(error), error.rule)
            return str(error)
        self.configured = True
        self.change_state(Trigger.CONFIGURE, "configured")
        return ""

    def deconfigure(self) -> Procedure[None]:
        """Switch the axes off and release them."""
        if self.configured:
            self.configured = False
            try:
                yield from self._axes.close()
            except AxisError as error:
                self.fail(str(error), error.rule)
        if self.state is State.DISABLED:
            self.snapshot = None
            self.change_state(Trigger.DECONFIGURE, "deconfigured")

    def reset(self, now: float) -> Procedure[str]:
        """Leave FAULT or ESTOPPED with the axes off; return the remaining problem."""
        trigger, reason = Trigger.RESET_UNCONFIGURED, "reset"
        if self.configured:
            try:
                yield from self._axes.side_by_side(lambda axis: axis.reset())
                self._axes.each(lambda axis: axis.power(False))
            except AxisError as error:
                return str(error)
            problem = axes_problem(
                self.poll(now), now, self._limits, require_power=False, require_home=False
            )
            if problem is not None:
                return problem.text
            trigger, reason = Trigger.RESET, "reset; enable to continue"
        self._fault = self._stop_failures = ""
        self.change_state(trigger, reason)
        return ""

    def start(self, activity: Activity, legs: Sequence[Leg], stamp_ns: int | None = None) -> None:
        """Begin a step or retraction; the stamp is that of the command [ns]."""
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
        self.change_state(Trigger.MOTION_START, "")
        if not self.snapshot.ready:
            # A stopped axis becomes ready only after a new order.
            self.order(lambda axis: axis.power(True))

    def replace(self, legs: Sequence[Leg], stamp_ns: int) -> None:
        """Replace the path under way from the last set-point on, and report its outcome.

        Parameters
        ----------
        legs : sequence of Leg
            The new path.
        stamp_ns : int
            Stamp of its command [ns].
        """
        assert self._run is not None
        assert self.snapshot is not None
        assert self.step_stamp_ns is not None
        self.report_result(self.step_stamp_ns, REPLACED)
        self._run.replace(legs, self.snapshot)
        self.step_stamp_ns = stamp_ns

    def start_homing(self) -> Procedure[str]:
        """Begin homing both axes; return the error."""
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
            # Cancelled: the axes stay where they are, without power.
            self.power_off()
            raise
        self._homing_times = HomingTimes(self._limits)
        self.activity = Activity.HOMING
        self.change_state(Trigger.HOMING_START, "homing")
        return ""

    def _end_motion(self, outcome: str, *, stop: bool) -> None:
        """End any motion; report the outcome of a step."""
        if stop:
            try:
                self._axes.each(lambda axis: axis.stop())
            except AxisError as error:
                self.notice(str(error), error.rule)
        if self.step_stamp_ns is not None:
            self.report_result(self.step_stamp_ns, outcome)
        self.activity = Activity.NONE
        self._run = self.step_stamp_ns = None

    def abort(self, reason: str) -> None:
        """Stop the motion under way."""
        homing = self.activity is Activity.HOMING
        self._end_motion(f"aborted: {reason}", stop=True)
        self.change_state(Trigger.HOMING_END if homing else Trigger.MOTION_END, reason)
        if homing:
            self.power_off()

    def fail(self, reason: str, rule: Rule | None = None) -> None:
        """Stop both axes because of a fault, which lasts until a reset."""
        self.stops += 1
        if self.state not in (State.FAULT, State.ESTOPPED):
            self._stop_and_latch(Trigger.FAIL, reason, rule)

    def emergency_stop(self) -> None:
        """Stop both axes in any state."""
        self.stops += 1
        if self.state is not State.ESTOPPED:
            self._stop_and_latch(Trigger.ESTOP, "emergency stop", Rule.ESTOP_LATCHES)

    def _stop_and_latch(self, trigger: Trigger, reason: str, rule: Rule | None) -> None:
        self._on_stop()
        self._fault = reason
        self._end_motion(f"aborted: {reason}", stop=True)
        self.change_state(trigger, reason)
        self._events.append(Notice(reason, rule, fault=True))
        try:
            # A powered drive would move a blocked axis as soon as it is freed.
            self._axes.each(lambda axis: axis.power(False))
        except AxisError as error:
            self.notice(str(error), error.rule)

    # ---- the cycle ----------------------------------------------------------------------------

    def poll(self, now: float) -> PairSnapshot:
        """Read the axes."""
        self.snapshot = self._axes.poll(now)
        self._retraction_bound.note(self.snapshot.insertion)
        return self.snapshot

    def drive_homing(self, period: float) -> None:
        """Add `period` [s] to the time of a homing."""
        assert self.snapshot is not None
        if text := self._homing_times.advance(self.snapshot, period):
            self.fail(text, Rule.HOMING_TIME)

    def drive(self, period: float, speed_scale: float, now: float) -> None:
        """Order the set-points of the next `period` [s] of the motion under way."""
        assert self._run is not None
        at = self.poll(now)
        if not at.answered:
            # A missing answer may mean a lost set-point: do not send another. An axis that stays
            # silent causes a fault.
            return
        problem = self._run.problem(at)
        if problem is not None:
            self.fail(problem.text, problem.rule)
            return
        set_point = self._run.advance(at, period, speed_scale)
        if set_point is None:
            return
        self._check_push_speed()
        try:
            if self._axes.insertion.actuated:
                self._axes.insertion.start_move(set_point.insertion, set_point.insertion_speed)
            if self.activity is Activity.STEP:
                self._axes.rotation.start_move(set_point.rotation, set_point.rotation_speed)
        except AxisError as error:
            self.fail(str(error), error.rule)

    def _check_push_speed(self) -> None:
        lag, reported = self.rotation_lag, self._pushed_too_fast
        self._pushed_too_fast = lag > 0.0
        if self._pushed_too_fast and not reported:
            text = f"pushed too fast: the rotation is {lag:.2f} rad behind, push more slowly"
            self.explain(text, Rule.MAX_ROTATION_RATE)

    def check_axes(self, now: float) -> None:
        """Read the axes, and stop both if one has a problem."""
        at = self.poll(now)
        if self.state not in _SUPERVISED:
            self._check_stopped(at, now)
            return
        on = self.state is not State.DISABLED
        problem = axes_problem(
            at,
            now,
            self._limits,
            # Switching on takes time: only a loss of power counts.
            require_power=on and self._was_powered,
            require_home=self.activity is Activity.STEP,
        )
        self._was_powered = on and (self._was_powered or at.powered)
        reported, self._released_after_block = self._released_after_block, at.released_after_block
        if at.released_after_block and not reported:
            text = "blocked when it was stopped; switched off until the next motion"
            self.explain(f"{at.released_after_block}: {text}", Rule.FOLLOWING_ERROR)
        if problem is not None:
            self.watchdog_trips += problem.rule is Rule.REPLY_AGE
            self.fail(problem.text, problem.rule)

    def _check_stopped(self, at: PairSnapshot, now: float) -> None:
        # In FAULT, silence may be the fault itself.
        oldest = now - self._limits.reply_age_limit if self.state is State.ESTOPPED else 0.0
        reported, self._stop_failures = self._stop_failures, at.stop_failures(oldest)
        if self._stop_failures not in ("", reported):
            self._events.append(Notice(self._stop_failures, Rule.QUICK_STOP, fault=True))

    def finish_completed_motion(self) -> None:
        """End a homing, step or retraction that has arrived."""
        at = self.snapshot
        assert at is not None
        if self.activity is Activity.HOMING:
            if at.homed and not (at.insertion.moving or at.rotation.moving):
                self._end_motion("", stop=False)
                self.change_state(Trigger.HOMING_END, "homed")
                self.power_off()
        elif self._run is not None and self._run.arrived(at):
            # A retraction that ends at the switch may still have a target.
            self._end_motion(SUCCEEDED, stop=self.activity is Activity.RETRACTION)
            self.change_state(Trigger.MOTION_END, "")
