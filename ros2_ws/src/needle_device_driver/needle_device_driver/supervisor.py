"""Who may move the needle, when, where to and how fast: every safety rule of the rig, once."""

from __future__ import annotations

from collections.abc import Callable

from needle_device_driver.axis import Axis, AxisError
from needle_device_driver.axis_pair import AxisPair, PairSnapshot
from needle_device_driver.command import Command, CommandContext, Refusal, check_command
from needle_device_driver.hold import Hold, HoldMessage
from needle_device_driver.limits import SafetyLimits
from needle_device_driver.motion_run import MotionRun
from needle_device_driver.reports import (
    SUCCEEDED,
    DeviceStatus,
    Event,
    JointSample,
    Notice,
    Reply,
    StepResult,
)
from needle_device_driver.rules import Rule
from needle_device_driver.stamp_ages import StampAges
from needle_device_driver.states import Activity, State, Trigger, next_state
from needle_device_driver.watch import axes_problem
from needle_device_driver.way_out import WayOut

_SWITCHING = "waiting for the axes to switch off"
_READY = (State.DISABLED, State.HOLDING, State.MOVING)


class MotionSupervisor:
    """The only way to the axes. `now` is everywhere the steady clock [s].

    A cycle is `drive(period, now)`, which orders the next set-points, and `observe(now)`, which
    reads the axes, watches over them and ends what has ended. `take_events` has what there is to
    tell.

    Parameters
    ----------
    insertion, rotation : Axis
        The two axes.
    limits : SafetyLimits
        The bounds of the rules.
    pause_on_lapse : bool
        A hold that falls silent pauses instead of aborting: only for a simulation in lock step,
        where the axes' own time stands still meanwhile. A release always aborts.
    feedback_delay : int
        How many cycles after its order a set-point shows in the axes' snapshots.
    switching : callable, optional
        Returns whether an axis is on its way to where it was ordered, apart from set-points.
    """

    def __init__(
        self,
        insertion: Axis,
        rotation: Axis,
        limits: SafetyLimits,
        *,
        pause_on_lapse: bool = False,
        feedback_delay: int = 0,
        switching: Callable[[], bool] = lambda: False,
    ) -> None:
        self._feedback_delay = feedback_delay
        self._switching = switching
        self._axes = AxisPair(insertion, rotation)
        self._limits = limits
        self._pause_on_lapse = pause_on_lapse
        self._hold = Hold(limits.hold_timeout)
        self._ages = StampAges(2.0 * limits.tip_age_limit)
        self._state = State.UNCONFIGURED
        self._activity = Activity.NONE
        self._configured = False
        self._estop_pressed = False
        self._needle_out = False
        self._snapshot: PairSnapshot | None = None
        self._seen_powered = False
        self._run: MotionRun | None = None
        self._step_stamp_ns: int | None = None
        self._last_stamp_ns: int | None = None
        self._homing_time = 0.0
        self._way_out = WayOut(limits.max_depth)
        self._fault = ""
        self._reason = ""
        self._watchdog_trips = 0
        self._commands_refused = 0
        self._hold_refusals: dict[str, Rule | None] = {}
        self._events: list[Event] = []

    # ---- what is told -------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """What the device may do."""
        return self._state

    @property
    def activity(self) -> Activity:
        """What moves."""
        return self._activity

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events

    def joints(self, now: float) -> JointSample | None:
        """Return the measured joints; None when there is no reply within the age limit."""
        snapshot = self._snapshot
        if snapshot is None or snapshot.age(now) > self._limits.reply_age_limit:
            return None
        return JointSample(
            snapshot.insertion.position,
            snapshot.rotation.position,
            snapshot.insertion.velocity,
            snapshot.rotation.velocity,
        )

    def may_move(self, now: float) -> bool:
        """Return whether what is under way would go on if `drive` were called now."""
        if self._activity is Activity.HOMING:
            return True
        return (
            self._activity is not Activity.NONE
            and self._hold.is_fresh(now)
            and self._hold.speed_scale > 0.0
        )

    def status(self, now: float) -> DeviceStatus:
        """Return the device's status."""
        joints = self.joints(now)
        return DeviceStatus(
            state=self._state,
            activity=self._activity,
            homed=self._snapshot is not None and self._snapshot.homed,
            hold_owner=self._hold.owner or "",
            speed_scale=self._hold.speed_scale,
            insertion=None if joints is None else joints.insertion,
            rotation=None if joints is None else joints.rotation,
            fault=self._fault,
            reason=self._reason,
            needle_out_confirmed=self._needle_out,
            watchdog_trips=self._watchdog_trips,
            commands_refused=self._commands_refused,
            needs_time=self.may_move(now) or self._switching(),
        )

    # ---- what comes from outside --------------------------------------------------------------

    def configure(self, now: float) -> Reply:
        """Set the axes up; moves nothing."""
        if self._state is not State.UNCONFIGURED:
            return Reply(False, f"the device is {self._state.value}, not UNCONFIGURED")
        try:
            self._axes.each(lambda axis: axis.configure())
        except AxisError as error:
            self.fail(str(error), error.rule)
            return Reply(False, str(error))
        self._configured = True
        self._go(Trigger.CONFIGURE, "configured")
        self.observe(now)
        return Reply(True, "configured")

    def close(self) -> None:
        """Stop whatever moves, switch the axes off and let go of them."""
        if self._activity is not Activity.NONE:
            self._end_motion("aborted: the device is shut down", stop=True)
        self._axes.each(lambda axis: axis.close())

    def deconfigure(self) -> Reply:
        """Stop, switch the axes off and let go of them; a fault or emergency stop stays."""
        if self._state in (State.HOLDING, State.MOVING):
            self._disable()
        if self._configured:
            self._configured = False
            try:
                self._axes.each(lambda axis: axis.close())
            except AxisError as error:
                self.fail(str(error), error.rule)
        if self._state is not State.DISABLED:
            return Reply(False, f"the device is {self._state.value}")
        self._snapshot = None
        self._go(Trigger.DECONFIGURE, "deconfigured")
        return Reply(True, "deconfigured")

    def note_time(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns] now; call it in each cycle."""
        self._ages.note(ros_ns, now)

    def receive_hold(self, message: HoldMessage, now: float) -> None:
        """Take a hold message that arrived now."""
        # A silence that nobody watched is one all the same.
        self._watch_hold(now)
        counting = self._state in (State.HOLDING, State.MOVING)
        rule = self._hold.receive(message, now, counting=counting)
        if rule is not self._hold_refusals.get(message.sender):
            self._hold_refusals[message.sender] = rule
            if rule is not None and counting:
                self._reason = f"hold of '{message.sender}' does not count ({rule.value})"
                self._events.append(Notice(self._reason, rule))
        if self._activity in (Activity.STEP, Activity.RETRACTION) and self._hold.owner is None:
            self._abort("hold released")

    def receive_estop(self, pressed: bool) -> None:
        """Take the state of the emergency stop; pressed latches."""
        self._estop_pressed = pressed
        if not pressed or self._state is State.ESTOPPED:
            return
        self._stop_for_good(Trigger.ESTOP, "emergency stop", Rule.ESTOP_LATCHES)

    def fail(self, reason: str, rule: Rule | None = None) -> None:
        """Stop both axes for a fault; it takes a reset to go on."""
        if self._state in (State.FAULT, State.ESTOPPED):
            return
        self._stop_for_good(Trigger.FAIL, reason, rule)

    def submit(self, command: Command, now: float, publishers: int = 1) -> None:
        """Take a step command: it starts at once, or is refused whole; a result tells which.

        Parameters
        ----------
        command : Command
            As received, nothing checked.
        now : float
            Steady time [s].
        publishers : int
            How many publish commands at present.
        """
        self._watch_hold(now)
        at = self._ready_for_step(now)
        if isinstance(at, Refusal):
            self._refuse(command, at)
            return
        context = CommandContext(
            insertion=at.insertion.position,
            rotation=at.rotation.position,
            homed=at.homed,
            last_stamp_ns=self._last_stamp_ns,
            tip_age=self._ages.age(command.stamp_ns, now),
            publishers=publishers,
        )
        step = check_command(command, context, self._limits)
        if isinstance(step, Refusal):
            self._refuse(command, step)
            return
        self._needle_out = False
        self._last_stamp_ns = self._step_stamp_ns = command.stamp_ns
        self._start(Activity.STEP, (step.insertion, step.rotation), step.duration, at)

    def count_watchdog_trip(self) -> None:
        """Count a watchdog of the supervisor's owner among its own."""
        self._watchdog_trips += 1

    # ---- services -----------------------------------------------------------------------------

    def enable(self, on: bool, now: float) -> Reply:
        """Switch the axes on, where nothing moves, or off."""
        if not on:
            return self._disable()
        if self._state is State.HOLDING:
            return Reply(True, "already enabled")
        if self._state is not State.DISABLED:
            return self._not_in(State.DISABLED)
        if self._switching():
            return Reply(False, _SWITCHING)
        self._seen_powered = False
        try:
            self._axes.each(lambda axis: axis.power(True))
        except AxisError as error:
            self.fail(str(error), error.rule)
            return Reply(False, str(error))
        self._hold.require_new_press()
        self._hold_refusals.clear()
        self._go(Trigger.ENABLE, "enabled; hold to run")
        self.observe(now)
        return Reply(True, "enabled; nothing moves without hold")

    def confirm_needle_out(self, confirmed: bool) -> Reply:
        """Take a person's word that the needle is out of the tissue; a step ends its validity."""
        if self._activity is not Activity.NONE:
            return Reply(False, f"a {self._activity.value} is under way")
        self._needle_out = confirmed
        return Reply(True, "needle out" if confirmed else "needle not out")

    def home(self, now: float) -> Reply:
        """Begin to look for both home switches; only with the needle out."""
        if self._state is not State.DISABLED:
            return self._not_in(State.DISABLED)
        if not self._needle_out:
            return Reply(False, "confirm first that the needle is out (confirm_needle_out)")
        if self._switching():
            return Reply(False, _SWITCHING)
        try:
            self._axes.each(lambda axis: axis.power(True))
            self._axes.insertion.home(self._limits.homing_speed)
            self._axes.rotation.home(self._limits.homing_rotation_rate)
        except AxisError as error:
            self.fail(str(error), error.rule)
            return Reply(False, str(error))
        self._seen_powered = False
        self._homing_time = 0.0
        self._activity = Activity.HOMING
        self._go(Trigger.HOMING_START, "homing")
        self.observe(now)
        return Reply(True, "homing" if self._activity is Activity.HOMING else "homed")

    def retract(self, now: float) -> Reply:  # noqa: PLR0911 - each return is a reason
        """Begin to draw the needle out: insertion axis only, slowly, while the hold lasts."""
        self._watch_hold(now)
        if self._state is not State.HOLDING:
            return self._not_in(State.HOLDING)
        if self._hold.owner is None:
            return Reply(False, "press and keep the hold first")
        at = self._poll(now)
        if not at.powered:
            return Reply(False, "the axes are not powered yet")
        if not self._axes.insertion.actuated:
            return Reply(False, "the insertion axis is moved by hand: draw the needle out by hand")
        insertion = at.insertion
        target = self._way_out.target(insertion)
        distance = insertion.position - target
        if distance <= self._limits.insertion_tolerance or insertion.at_home_switch:
            return Reply(True, "the needle is out")
        end = (target, at.rotation.position)
        duration = distance / self._limits.retraction_speed
        self._start(Activity.RETRACTION, end, duration, at)
        if self._run is None:
            return Reply(False, self._fault)
        return Reply(True, f"retracting {distance * 1e3:.1f} mm while the hold lasts")

    def stop(self) -> Reply:
        """Stop whatever moves; it takes a new press to move again."""
        self._hold.require_new_press()
        if self._activity is Activity.NONE:
            return Reply(True, "nothing moves")
        activity = self._activity.value
        self._abort("stopped on request")
        return Reply(True, f"{activity} stopped")

    def reset(self, now: float) -> Reply:  # noqa: PLR0911 - each return is a reason
        """Leave FAULT or ESTOPPED; moves nothing and enables nothing."""
        if self._state is State.MOVING:
            return Reply(False, f"a {self._activity.value} is under way")
        self._hold.require_new_press()
        if self._state not in (State.FAULT, State.ESTOPPED):
            return Reply(True, "nothing to reset")
        if self._estop_pressed:
            return Reply(False, "the emergency stop is still pressed")
        if not self._hold.is_off(now):
            return Reply(False, "release the hold first")
        if not self._configured:
            self._fault = ""
            self._go(Trigger.RESET_UNCONFIGURED, "reset")
            return Reply(True, "reset; the device is not configured")
        try:
            self._axes.each(lambda axis: axis.reset())
            self._axes.each(lambda axis: axis.power(False))
        except AxisError as error:
            return Reply(False, str(error))
        problem = axes_problem(
            self._poll(now), now, self._limits, powered_wanted=False, homed_wanted=False
        )
        if problem is not None:
            return Reply(False, problem[1])
        self._fault = ""
        self._go(Trigger.RESET, "reset; enable to go on")
        return Reply(True, "reset; enable to go on")

    # ---- the cycle ----------------------------------------------------------------------------

    def drive(self, period: float, now: float) -> None:
        """Order the set-points of the next `period` [s] of the axes' time, if anything may move."""
        if self._activity is Activity.HOMING:
            self._homing_time += period
            if self._homing_time > self._limits.max_homing_time:
                self.fail(
                    f"no home switch within {self._limits.max_homing_time:.0f} s", Rule.HOMING_TIME
                )
            return
        self._watch_hold(now)
        if self._run is None or self._snapshot is None or not self.may_move(now):
            return
        problem = self._run.problem(self._snapshot)
        if problem is not None:
            self.fail(problem[1], problem[0])
            return
        set_point = self._run.advance(self._snapshot, period, self._hold.speed_scale)
        if set_point is None:
            return
        try:
            if self._axes.insertion.actuated:
                self._axes.insertion.start_move(set_point.insertion, set_point.insertion_speed)
            if self._activity is Activity.STEP:
                self._axes.rotation.start_move(set_point.rotation, set_point.rotation_speed)
        except AxisError as error:
            self.fail(str(error), error.rule)

    def observe(self, now: float) -> None:
        """Read the axes, watch over them and the hold, and end what has ended."""
        if not self._configured:
            return
        at = self._poll(now)
        self._watch_axes(at, now)
        self._watch_hold(now)
        if self._activity is Activity.HOMING:
            self._end_homing(at)
        elif self._run is not None and self._run.arrived(at):
            # At the switch a retraction may have a target still.
            self._end_motion(SUCCEEDED, stop=self._activity is Activity.RETRACTION)
            self._go(Trigger.MOTION_END, "")

    def _poll(self, now: float) -> PairSnapshot:
        self._snapshot = self._axes.poll(now)
        self._way_out.note(self._snapshot.insertion)
        return self._snapshot

    def _watch_axes(self, at: PairSnapshot, now: float) -> None:
        if self._state not in _READY:
            return
        on = self._state is not State.DISABLED
        problem = axes_problem(
            at,
            now,
            self._limits,
            # Drives take a while to switch on: only a loss counts.
            powered_wanted=on and self._seen_powered,
            homed_wanted=self._activity is Activity.STEP,
        )
        self._seen_powered = on and (self._seen_powered or at.powered)
        if problem is not None:
            self._watchdog_trips += problem[0] is Rule.REPLY_AGE
            self.fail(problem[1], problem[0])

    def _watch_hold(self, now: float) -> None:
        age = self._hold.age(now)
        if not self._hold.lapses(now):
            return
        moving = self._activity in (Activity.STEP, Activity.RETRACTION)
        self._watchdog_trips += moving
        text = f"no hold message for {age:.3f} s, limit {self._limits.hold_timeout:g} s"
        self._events.append(Notice(text, Rule.HOLD_AGE))
        if self._pause_on_lapse:
            self._reason = text + ": paused"
            return
        self._hold.require_new_press()
        self._reason = text + ": release and press again"
        if moving:
            self._abort(text)

    # ---- ways from state to state -------------------------------------------------------------

    def _go(self, trigger: Trigger, reason: str) -> None:
        self._state = next_state(self._state, trigger)
        self._reason = reason

    def _not_in(self, wanted: State) -> Reply:
        return Reply(False, f"the device is {self._state.value}, not {wanted.value}")

    def _disable(self) -> Reply:
        self._hold.require_new_press()
        if self._activity is not Activity.NONE:
            self._abort("disabled on request")
        if self._state is State.HOLDING:
            self._go(Trigger.DISABLE, "disabled on request")
        error = self._power_off() if self._configured else ""
        if error:
            return Reply(False, error)
        return Reply(True, "disabled")

    def _start(
        self, activity: Activity, end: tuple[float, float], duration: float, at: PairSnapshot
    ) -> None:
        self._activity = activity
        self._run = MotionRun(
            activity,
            end,
            duration,
            at,
            self._limits,
            feedback_delay=self._feedback_delay,
            pushed=not self._axes.insertion.actuated,
        )
        self._go(Trigger.MOTION_START, "")
        if at.ready:
            return
        try:
            # After a stop, an axis is made ready by the order to move, never by itself.
            self._axes.each(lambda axis: axis.power(True))
        except AxisError as error:
            self.fail(str(error), error.rule)

    def _end_motion(self, outcome: str, *, stop: bool) -> None:
        if stop:
            try:
                self._axes.each(lambda axis: axis.stop())
            except AxisError as error:
                self._events.append(Notice(str(error), error.rule))
        if self._activity is Activity.STEP and self._step_stamp_ns is not None:
            self._events.append(StepResult(self._step_stamp_ns, outcome))
        self._activity = Activity.NONE
        self._run = self._step_stamp_ns = None

    def _abort(self, reason: str) -> None:
        homing = self._activity is Activity.HOMING
        self._end_motion(f"aborted: {reason}", stop=True)
        self._go(Trigger.HOMING_END if homing else Trigger.MOTION_END, reason)
        if homing:
            self._power_off()

    def _stop_for_good(self, trigger: Trigger, reason: str, rule: Rule | None) -> None:
        self._hold.require_new_press()
        self._fault = reason
        self._end_motion(f"aborted: {reason}", stop=True)
        self._go(trigger, reason)
        self._events.append(Notice(reason, rule))

    def _end_homing(self, at: PairSnapshot) -> None:
        if not at.homed or at.insertion.moving or at.rotation.moving:
            return
        self._end_motion("", stop=False)
        self._go(Trigger.HOMING_END, "homed")
        self._power_off()

    def _power_off(self) -> str:
        """Switch both axes off; return what went wrong."""
        try:
            self._axes.each(lambda axis: axis.power(False))
        except AxisError as error:
            self.fail(str(error), error.rule)
            return str(error)
        return ""

    def _ready_for_step(self, now: float) -> PairSnapshot | Refusal:
        if self._state is not State.HOLDING:
            return Refusal(
                Rule.COMMAND_STATE, f"the device is {self._state.value}, not {State.HOLDING.value}"
            )
        if self._hold.owner is None:
            return Refusal(Rule.HOLD_TO_RUN, "nobody holds to run")
        # Not the last cycle's: a stop since then must be known.
        at = self._poll(now)
        if at.age(now) > self._limits.reply_age_limit:
            return Refusal(Rule.REPLY_AGE, "no fresh reply from the axes")
        if not at.powered:
            return Refusal(Rule.COMMAND_STATE, "the axes are not powered yet")
        return at

    def _refuse(self, command: Command, refusal: Refusal) -> None:
        self._commands_refused += 1
        self._watchdog_trips += refusal.rule is Rule.TIP_AGE
        self._reason = f"command refused: {refusal.reason}"
        self._events.append(Notice(self._reason, refusal.rule))
        # The running step's own stamp would tell its sender that the step has ended.
        if command.stamp_ns != self._step_stamp_ns:
            self._events.append(StepResult(command.stamp_ns, f"aborted: {refusal.reason}"))
