"""Motion supervisor: enforces every safety rule in one place."""

from __future__ import annotations

from needle_core.diagnostics import Level, sanitize
from needle_core.messages import HoldState, Trajectory
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import Axis, AxisPair, PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.procedure import Procedure
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import CommandHandler
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold, HoldNotices
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import Event, ServiceResult
from needle_device_driver.supervisor.states import Activity, State, Trigger

_LEVELS = {State.FAULT: Level.ERROR, State.ESTOPPED: Level.ERROR, State.UNCONFIGURED: Level.WARN}
_SWITCHING = "waiting for the axes to switch off"


class MotionSupervisor:
    """The only access to the axes; `now` is the steady time [s] in every method.

    A cycle is `drive(period, now)`, which orders set-points, then `observe(now)`, which reads and
    checks the axes. `pop_events` returns the reports.

    Parameters
    ----------
    insertion, rotation : Axis
        The two axes.
    limits : SafetyLimits
        The bounds of the rules.
    feedback_delay : int
        Number of cycles until a set-point shows in the feedback.

    Attributes
    ----------
    conflict : str
        Another device on the same topics; empty: there is none.
    """

    def __init__(
        self,
        insertion: Axis,
        rotation: Axis,
        limits: SafetyLimits,
        *,
        feedback_delay: int = 0,
    ) -> None:
        self._axes = AxisPair(insertion, rotation)
        self._limits = limits
        self._hold = Hold(limits.hold_timeout)
        self._hold_notices = HoldNotices()
        self._estop_pressed = False
        self._needle_out = False
        self.conflict = ""
        self._core = DeviceCore(
            self._axes,
            limits,
            feedback_delay=feedback_delay,
            on_stop=self._hold.require_new_press,
        )
        self._commands = CommandHandler(self._core, self._hold, limits)

    # ---- reports ------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """State of the device."""
        return self._core.state

    @property
    def stops(self) -> int:
        """Number of faults and emergency stops, including those in FAULT and ESTOPPED."""
        return self._core.stops

    @property
    def fault(self) -> str:
        """Reason for the state FAULT or ESTOPPED; otherwise empty."""
        return self._core.fault

    def pop_events(self) -> tuple[Event, ...]:
        """Return the events since the last call."""
        return self._core.pop_events()

    def joints(self, now: float) -> PairSnapshot | None:
        """Return the measured joints; None if the feedback is older than the age limit."""
        at = self._core.snapshot
        return None if at is None or at.age(now) > self._limits.reply_age_limit else at

    def may_move(self, now: float) -> bool:
        """Return whether `drive` would continue the motion under way."""
        if self._core.activity is Activity.HOMING:
            return True
        is_held = self._hold.is_fresh(now) and self._hold.speed_scale > 0.0
        return self._core.activity is not Activity.NONE and is_held

    def status(
        self, now: float, source: str = "", *, simulated: bool | None = None
    ) -> DeviceStatus:
        """Return the device's status with the given source and `simulated`."""
        joints, state, fault = self.joints(now), self._core.state, self.fault
        return DeviceStatus(
            source=source,
            level=_LEVELS.get(state, Level.OK),
            text=fault or self._core.reason or state.value,
            state=state.value,
            activity=self._core.activity.value,
            homed=self._core.snapshot is not None and self._core.snapshot.homed,
            hold_owner=sanitize(self._hold.owner or ""),
            press_again=sanitize(self._hold.ignored_press(now) or ""),
            speed_scale=self._hold.speed_scale,
            insertion_m=None if joints is None else joints.insertion.position,
            rotation_rad=None if joints is None else joints.rotation.position,
            fault=fault,
            reason=self._core.reason,
            needle_out_confirmed=self._needle_out,
            watchdog_trips=self._core.watchdog_trips,
            commands_refused=self._commands.refused,
            holds_ignored=self._hold.ignored,
            command_ns=self._commands.newest_ns,
            rotation_owed_rad=self._core.rotation_lag,
            simulated=simulated,
        )

    # ---- inputs -------------------------------------------------------------------------------

    def configure(self, now: float) -> Procedure[ServiceResult]:
        """Set the axes up; moves nothing."""
        if self._core.state is not State.UNCONFIGURED:
            return self._wrong_state(State.UNCONFIGURED)
        if error := (yield from self._core.configure()):
            return ServiceResult(False, error)
        self.observe(now)
        return ServiceResult(True, "configured")

    def deconfigure(self) -> Procedure[None]:
        """Stop, switch the axes off and release them; a fault or emergency stop remains."""
        if self._core.state in (State.HOLDING, State.MOVING):
            self._disable()
        yield from self._core.deconfigure()

    def note_time(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns]; call it in each cycle."""
        self._commands.stamps.note(ros_ns, now)

    def receive_hold(self, message: HoldState, now: float) -> None:
        """Receive a hold message."""
        # The cycle may not have checked the last gap between messages yet.
        self._check_hold_age(now)
        counting = self._core.state in (State.HOLDING, State.MOVING)
        rule = self._hold.receive(message, now, counting=counting)
        text = self._hold_notices.text_for(message, rule, known=self._hold.knows(message.source))
        if text and rule is not None and counting:
            self._core.explain(text, rule)
        if self._core.needs_hold and self._hold.owner is None:
            self._core.abort("hold released")

    def receive_estop(self, pressed: bool) -> None:
        """Receive the state of the emergency stop; pressed latches."""
        self._estop_pressed = pressed
        if pressed:
            self._core.emergency_stop()

    def report_conflicting_device(self, conflict: str) -> None:
        """Fail if another device uses the same topics; an empty text means there is none."""
        if conflict == self.conflict:
            return
        self.conflict = conflict
        if conflict:
            # The confirmation may have been meant for the other device.
            self._needle_out = False
            self._core.fail(conflict, Rule.ONE_DEVICE)

    def fail(self, reason: str, rule: Rule | None = None) -> None:
        """Stop both axes because of a fault, which lasts until a reset."""
        self._core.fail(reason, rule)

    def submit(self, command: Trajectory, now: float, publishers: int = 1) -> None:
        """Handle a command: it starts or is refused as a whole, and a result reports which.

        A path replaces the path under way.

        Parameters
        ----------
        command : Trajectory
            The command as received, unchecked.
        now : float
            Steady time [s].
        publishers : int
            Number of publishers of commands.
        """
        self._check_hold_age(now)
        if self._commands.submit(command, now, publishers):
            self._needle_out = False

    # ---- services -----------------------------------------------------------------------------

    def enable(self, on: bool, now: float) -> ServiceResult:
        """Switch the axes on, without motion, or off."""
        if not on:
            return self._disable()
        if self._core.state is State.HOLDING:
            return ServiceResult(True, "already enabled")
        if self._core.state is not State.DISABLED:
            return self._wrong_state(State.DISABLED)
        if self._axes.needs_cycles:
            return ServiceResult(False, _SWITCHING)
        if error := self._core.power_on():
            return ServiceResult(False, error)
        self._hold.require_new_press()
        self._hold_notices.clear()
        self._core.change_state(Trigger.ENABLE, "enabled; hold to run")
        self.observe(now)
        return ServiceResult(True, "enabled; nothing moves without hold")

    def confirm_needle_out(self, confirmed: bool) -> ServiceResult:
        """Record a person's confirmation that the needle is out; the next step cancels it."""
        if self._core.activity is not Activity.NONE:
            return ServiceResult(False, f"a {self._core.activity.value} is under way")
        if confirmed and self.conflict:
            return ServiceResult(False, self.conflict)
        self._needle_out = confirmed
        return ServiceResult(True, "needle out" if confirmed else "needle not out")

    def home(self, now: float) -> Procedure[ServiceResult]:
        """Begin homing both axes; requires that the needle is out."""
        if self._core.state is not State.DISABLED:
            return self._wrong_state(State.DISABLED)
        if not self._needle_out:
            return ServiceResult(False, "confirm first that the needle is out (confirm_needle_out)")
        if self._axes.needs_cycles:
            return ServiceResult(False, _SWITCHING)
        if error := (yield from self._core.start_homing()):
            return ServiceResult(False, error)
        self.observe(now)
        homing = self._core.activity is Activity.HOMING
        return ServiceResult(True, "homing" if homing else "homed")

    def retract(self, now: float) -> ServiceResult:  # noqa: PLR0911 - each return is a reason
        """Begin retracting the needle: slowly, without rotation, while the hold lasts."""
        self._check_hold_age(now)
        if self._core.state is not State.HOLDING:
            return self._wrong_state(State.HOLDING)
        if self._hold.owner is None:
            return ServiceResult(False, "press the hold first and keep it pressed")
        at = self._core.poll(now)
        if not at.powered:
            return ServiceResult(False, "the axes are not powered yet")
        if not self._axes.insertion.actuated:
            return ServiceResult(
                False, "the insertion axis is moved by hand: withdraw the needle by hand"
            )
        distance = self._core.retraction_distance
        if distance <= self._limits.insertion_tolerance or at.insertion.at_home_switch:
            return ServiceResult(True, "the needle is out")
        duration = distance / self._limits.retraction_speed
        leg = Leg(at.insertion.position - distance, at.rotation.position, duration)
        self._core.start(Activity.RETRACTION, [leg])
        if self._core.activity is not Activity.RETRACTION:
            return ServiceResult(False, self._core.fault)
        return ServiceResult(True, f"retracting {distance * 1e3:.1f} mm while the hold lasts")

    def stop(self) -> ServiceResult:
        """Stop any motion; the next one needs a new press."""
        self._hold.require_new_press()
        if self._core.activity is Activity.NONE:
            return ServiceResult(True, "nothing moves")
        activity = self._core.activity.value
        self._core.abort("stopped on request")
        return ServiceResult(True, f"{activity} stopped")

    def reset(self, now: float) -> Procedure[ServiceResult]:  # noqa: PLR0911 - each is a reason
        """Leave FAULT or ESTOPPED, and clear rejected stamps; moves and enables nothing."""
        if self._core.state is State.MOVING:
            return ServiceResult(False, f"a {self._core.activity.value} is under way")
        self._hold.clear_rejections()
        self._hold_notices.clear()
        self._commands.stamps.clear_rejections()
        if self._core.state not in (State.FAULT, State.ESTOPPED):
            return ServiceResult(True, "nothing to reset")
        if self.conflict:
            return ServiceResult(False, self.conflict)
        if self._estop_pressed:
            return ServiceResult(False, "the emergency stop is still pressed")
        if not self._hold.is_off(now):
            return ServiceResult(False, "release the hold first")
        if problem := (yield from self._core.reset(now)):
            return ServiceResult(False, problem)
        if not self._core.configured:
            return ServiceResult(True, "reset; the device is not configured")
        return ServiceResult(True, self._core.reason)

    # ---- the cycle ----------------------------------------------------------------------------

    def drive(self, period: float, now: float) -> None:
        """Order the set-points of the next `period` [s] if the device may move."""
        if self._core.activity is Activity.HOMING:
            self._core.drive_homing(period)
            return
        self._check_hold_age(now)
        self._commands.check_path_age(now)
        if self.may_move(now):
            self._core.drive(period, self._hold.speed_scale, now)

    def observe(self, now: float) -> None:
        """Read the axes, check them and the hold, and finish a completed motion."""
        if not self._core.configured:
            return
        self._core.check_axes(now)
        self._check_hold_age(now)
        self._core.finish_completed_motion()

    def _check_hold_age(self, now: float) -> None:
        text = self._hold.end_if_stale(now)
        if not text:
            return
        moving = self._core.needs_hold
        self._core.notice(text, Rule.HOLD_AGE)
        self._core.reason = text + ": release and press again"
        if moving:
            self._core.watchdog_trips += 1
            self._core.abort(text)

    def _wrong_state(self, expected: State) -> ServiceResult:
        return ServiceResult(False, f"the device is {self._core.state.value}, not {expected.value}")

    def _disable(self) -> ServiceResult:
        self._hold.require_new_press()
        if self._core.activity is not Activity.NONE:
            self._core.abort("disabled on request")
        if self._core.state is State.HOLDING:
            self._core.change_state(Trigger.DISABLE, "disabled on request")
        error = self._core.power_off() if self._core.configured else ""
        return ServiceResult(False, error) if error else ServiceResult(True, "disabled")
