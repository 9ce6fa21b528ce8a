"""Safety rules of the rig, each once: who may move the needle, when, where to and how fast."""

from __future__ import annotations

from collections.abc import Callable

from needle_core.diagnostics import Level, sanitize
from needle_core.messages import HoldState
from needle_core.status_messages import DeviceStatus
from needle_device_driver.axes.axis import Axis
from needle_device_driver.axes.axis_pair import AxisPair, PairSnapshot
from needle_device_driver.axes.motion import Leg
from needle_device_driver.procedure import Procedure
from needle_device_driver.rules import Rule
from needle_device_driver.supervisor.command import Command
from needle_device_driver.supervisor.command_desk import CommandDesk
from needle_device_driver.supervisor.device_core import DeviceCore
from needle_device_driver.supervisor.hold import Hold, HoldRefusals
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_device_driver.supervisor.reports import Event, Reply
from needle_device_driver.supervisor.states import Activity, State, Trigger

_LEVELS = {State.FAULT: Level.ERROR, State.ESTOPPED: Level.ERROR, State.UNCONFIGURED: Level.WARN}
_SWITCHING = "waiting for the axes to switch off"


class MotionSupervisor:
    """The only way to the axes. `now` is everywhere the steady clock [s].

    A cycle is `drive(period, now)`, which orders set-points, and `observe(now)`, which reads the
    axes, watches over them and ends what has ended. `take_events` has what there is to tell.

    Parameters
    ----------
    insertion, rotation : Axis
        The two axes.
    limits : SafetyLimits
        The bounds of the rules.
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
        feedback_delay: int = 0,
        switching: Callable[[], bool] = lambda: False,
    ) -> None:
        self._switching = switching
        self._axes = AxisPair(insertion, rotation)
        self._limits = limits
        self._hold = Hold(limits.hold_timeout)
        self._hold_refusals = HoldRefusals()
        self._estop_pressed = False
        self._needle_out = False
        self._others = ""
        self._core = DeviceCore(
            self._axes,
            limits,
            feedback_delay=feedback_delay,
            on_stop=self._hold.require_new_press,
        )
        self._commands = CommandDesk(self._core, self._hold, limits)

    # ---- what is told -------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """State of the device."""
        return self._core.state

    @property
    def activity(self) -> Activity:
        """Kind of the motion under way."""
        return self._core.activity

    @property
    def stops(self) -> int:
        """Number of faults and emergency stops, also while there was one already."""
        return self._core.stops

    @property
    def command_ns(self) -> int:
        """Stamp of the newest command, whatever became of it [ns]; 0: none yet."""
        return self._commands.newest_ns

    def take_events(self) -> tuple[Event, ...]:
        """Return what happened since the last call."""
        return self._core.take_events()

    def joints(self, now: float) -> PairSnapshot | None:
        """Return the measured joints; None when there is no reply within the age limit."""
        at = self._core.snapshot
        return None if at is None or at.age(now) > self._limits.reply_age_limit else at

    def held(self, now: float) -> bool:
        """Return whether somebody holds who was heard within the time-out, at a speed above 0."""
        return self._hold.is_fresh(now) and self._hold.speed_scale > 0.0

    def may_move(self, now: float) -> bool:
        """Return whether what is under way would go on if `drive` were called now."""
        if self._core.activity is Activity.HOMING:
            return True
        return self._core.activity is not Activity.NONE and self.held(now)

    @property
    def fault(self) -> str:
        """Reason for the state FAULT or ESTOPPED; else empty."""
        return self._core.fault_now

    def status(
        self, now: float, source: str = "", *, simulated: bool | None = None
    ) -> DeviceStatus:
        """Return the device's status; name and `simulated` are known to its owner alone."""
        joints, state, fault = self.joints(now), self._core.state, self.fault
        return DeviceStatus(
            source=source,
            level=_LEVELS.get(state, Level.OK),
            text=fault or self._core.reason or state.value,
            state=state.value,
            activity=self._core.activity.value,
            homed=self._core.snapshot is not None and self._core.snapshot.homed,
            hold_owner=sanitize(self._hold.owner or ""),
            press_again=sanitize(self._hold.unheeded(now) or ""),
            speed_scale=self._hold.speed_scale,
            insertion_m=None if joints is None else joints.insertion.position,
            rotation_rad=None if joints is None else joints.rotation.position,
            fault=fault,
            reason=self._core.reason,
            needle_out_confirmed=self._needle_out,
            watchdog_trips=self._core.watchdog_trips,
            commands_refused=self._commands.refused,
            holds_ignored=self._hold.ignored,
            command_ns=self.command_ns,
            rotation_owed_rad=self._core.rotation_owed,
            simulated=simulated,
        )

    # ---- what comes from outside --------------------------------------------------------------

    def configure(self, now: float) -> Procedure[Reply]:
        """Set the axes up; moves nothing."""
        if self._core.state is not State.UNCONFIGURED:
            return self._not_in(State.UNCONFIGURED)
        if error := (yield from self._core.configure()):
            return Reply(False, error)
        self.observe(now)
        return Reply(True, "configured")

    def deconfigure(self) -> Procedure[Reply]:
        """Stop, switch the axes off and let go of them; a fault or emergency stop stays."""
        if self._core.state in (State.HOLDING, State.MOVING):
            self._disable()
        if not (yield from self._core.let_go()):
            return Reply(False, f"the device is {self._core.state.value}")
        return Reply(True, "deconfigured")

    def note_time(self, ros_ns: int, now: float) -> None:
        """Note that ROS time is `ros_ns` [ns] now; call it in each cycle."""
        self._commands.note_time(ros_ns, now)

    def receive_hold(self, message: HoldState, now: float) -> None:
        """Take a hold message that arrived now."""
        # A silence that nobody watched is one all the same.
        self._watch_hold(now)
        counting = self._core.state in (State.HOLDING, State.MOVING)
        rule = self._hold.receive(message, now, counting=counting)
        text = self._hold_refusals.take(message, rule, known=self._hold.knows(message.source))
        if text and counting:
            self._core.explain(text)
            self._core.notice(text, rule)
        if self._core.moves_with_hold and self._hold.owner is None:
            self._core.abort("hold released")

    def receive_estop(self, pressed: bool) -> None:
        """Take the state of the emergency stop; pressed latches."""
        self._estop_pressed = pressed
        if pressed:
            self._core.emergency_stop()

    def see_others(self, others: str) -> None:
        """Take who else is a device on these topics; empty: nobody, as it must be."""
        if others == self._others:
            return
        self._others = others
        if others:
            # Whoever said that a needle is out may have meant the other's.
            self._needle_out = False
            self._core.fail(others, Rule.ONE_DEVICE)

    def fail(self, reason: str, rule: Rule | None = None) -> None:
        """Stop both axes for a fault; it takes a reset to go on."""
        self._core.fail(reason, rule)

    def submit(self, command: Command, now: float, publishers: int = 1) -> None:
        """Take a command: it starts, or is refused whole; a result tells which.

        A path takes the place of the one under way.

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
        if self._commands.submit(command, now, publishers):
            self._needle_out = False

    def count_watchdog_trip(self) -> None:
        """Count a watchdog of the supervisor's owner among its own."""
        self._core.count_watchdog_trip()

    # ---- services -----------------------------------------------------------------------------

    def enable(self, on: bool, now: float) -> Reply:
        """Switch the axes on, where nothing moves, or off."""
        if not on:
            return self._disable()
        if self._core.state is State.HOLDING:
            return Reply(True, "already enabled")
        if self._core.state is not State.DISABLED:
            return self._not_in(State.DISABLED)
        if self._switching():
            return Reply(False, _SWITCHING)
        if error := self._core.power_on():
            return Reply(False, error)
        self._hold.require_new_press()
        self._hold_refusals.clear()
        self._core.go(Trigger.ENABLE, "enabled; hold to run")
        self.observe(now)
        return Reply(True, "enabled; nothing moves without hold")

    def confirm_needle_out(self, confirmed: bool) -> Reply:
        """Take a person's word that the needle is out of the tissue; a step ends its validity."""
        if self._core.activity is not Activity.NONE:
            return Reply(False, f"a {self._core.activity.value} is under way")
        if confirmed and self._others:
            return Reply(False, self._others)
        self._needle_out = confirmed
        return Reply(True, "needle out" if confirmed else "needle not out")

    def home(self, now: float) -> Procedure[Reply]:
        """Begin to look for both home switches; only with the needle out."""
        if self._core.state is not State.DISABLED:
            return self._not_in(State.DISABLED)
        if not self._needle_out:
            return Reply(False, "confirm first that the needle is out (confirm_needle_out)")
        if self._switching():
            return Reply(False, _SWITCHING)
        if error := (yield from self._core.start_homing()):
            return Reply(False, error)
        self.observe(now)
        return Reply(True, "homing" if self._core.activity is Activity.HOMING else "homed")

    def retract(self, now: float) -> Reply:  # noqa: PLR0911 - each return is a reason
        """Begin to draw the needle out: insertion axis only, slowly, while the hold lasts."""
        self._watch_hold(now)
        if self._core.state is not State.HOLDING:
            return self._not_in(State.HOLDING)
        if self._hold.owner is None:
            return Reply(False, "press and keep the hold first")
        at = self._core.poll(now)
        if not at.powered:
            return Reply(False, "the axes are not powered yet")
        if not self._axes.insertion.actuated:
            return Reply(False, "the insertion axis is moved by hand: draw the needle out by hand")
        distance = self._core.way_out
        if distance <= self._limits.insertion_tolerance or at.insertion.at_home_switch:
            return Reply(True, "the needle is out")
        duration = distance / self._limits.retraction_speed
        way = [Leg(at.insertion.position - distance, at.rotation.position, duration)]
        self._core.start(Activity.RETRACTION, way)
        if self._core.activity is not Activity.RETRACTION:
            return Reply(False, self._core.fault)
        return Reply(True, f"retracting {distance * 1e3:.1f} mm while the hold lasts")

    def stop(self) -> Reply:
        """Stop whatever moves; it takes a new press to move again."""
        self._hold.require_new_press()
        if self._core.activity is Activity.NONE:
            return Reply(True, "nothing moves")
        activity = self._core.activity.value
        self._core.abort("stopped on request")
        return Reply(True, f"{activity} stopped")

    def reset(self, now: float) -> Procedure[Reply]:  # noqa: PLR0911 - each return is a reason
        """Leave FAULT or ESTOPPED, let in whom old stamps shut out; moves and enables nothing."""
        if self._core.state is State.MOVING:
            return Reply(False, f"a {self._core.activity.value} is under way")
        self._hold.readmit()
        self._hold_refusals.clear()
        self._commands.readmit()
        if self._core.state not in (State.FAULT, State.ESTOPPED):
            return Reply(True, "nothing to reset")
        if self._others:
            return Reply(False, self._others)
        if self._estop_pressed:
            return Reply(False, "the emergency stop is still pressed")
        if not self._hold.is_off(now):
            return Reply(False, "release the hold first")
        if problem := (yield from self._core.reset(now)):
            return Reply(False, problem)
        if not self._core.configured:
            return Reply(True, "reset; the device is not configured")
        return Reply(True, self._core.reason)

    # ---- the cycle ----------------------------------------------------------------------------

    def drive(self, period: float, now: float) -> None:
        """Order the set-points of the next `period` [s] of the axes' time, if anything may move."""
        if self._core.activity is Activity.HOMING:
            self._core.drive_homing(period)
            return
        self._watch_hold(now)
        self._commands.watch_path(now)
        if self.may_move(now):
            self._core.drive(period, self._hold.speed_scale, now)

    def observe(self, now: float) -> None:
        """Read the axes, watch over them and the hold, and end what has ended."""
        if not self._core.configured:
            return
        self._core.watch_axes(now)
        self._watch_hold(now)
        self._core.end_what_has_ended()

    def _watch_hold(self, now: float) -> None:
        text = self._hold.lapse(now)
        if not text:
            return
        core = self._core
        moving = core.moves_with_hold
        core.notice(text, Rule.HOLD_AGE)
        core.explain(text + ": release and press again")
        if moving:
            core.count_watchdog_trip()
            core.abort(text)

    # ---- answers ------------------------------------------------------------------------------

    def _not_in(self, wanted: State) -> Reply:
        return Reply(False, f"the device is {self._core.state.value}, not {wanted.value}")

    def _disable(self) -> Reply:
        self._hold.require_new_press()
        if self._core.activity is not Activity.NONE:
            self._core.abort("disabled on request")
        if self._core.state is State.HOLDING:
            self._core.go(Trigger.DISABLE, "disabled on request")
        error = self._core.power_off() if self._core.configured else ""
        return Reply(False, error) if error else Reply(True, "disabled")
