"""An axis whose drive speaks CiA 402 over CAN."""

from __future__ import annotations

import enum

from needle_device_driver import objects as od
from needle_device_driver.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.can_link import CanLink, LinkError
from needle_device_driver.cia402 import (
    FAULTS,
    FOLLOWING_ERROR,
    HOMING_ATTAINED,
    HOMING_ERROR,
    POWERED,
    START_HOMING,
    TARGET_REACHED,
    DriveCommand,
    DriveState,
    Goal,
    Mode,
    TransitionWatch,
    drive_state,
    next_command,
)
from needle_device_driver.drive_monitor import DriveMonitor, Feedback
from needle_device_driver.drive_settings import HERE, DriveSettings
from needle_device_driver.drive_setup import (
    arm_watchdog,
    disarm_watchdog,
    set_up,
    write_homing,
    write_limits,
)
from needle_device_driver.emergency import HEARTBEAT_LOST, describe_error
from needle_device_driver.object_access import DriveError, ObjectAccess, send_heartbeat
from needle_device_driver.rules import Rule

# In cycles.
_REST = 3
_LONGEST_REST = 50
_LONGEST_SWITCHING = 100
_LONGEST_REENABLE = 10
_INSTANT_HOMING = 5
_SILENT = 5
# In seconds.
_HEARTBEAT_WAIT = 0.3
_FAULT_RESET_WAIT = 1.0

Fault = tuple[Rule, str]


class Homing(enum.Enum):
    """How far a homing is."""

    NONE = "none"
    PREPARING = "preparing"
    RUNNING = "running"


class Cia402Axis(Axis):
    """Steers one drive: a state machine towards a goal, set-points in cyclic position mode.

    Orders are taken at once and carried out by `transmit` and `update`, once a cycle each, around
    a SYNC; a stop goes out immediately. The drive runs to the last set-point and ends there: when
    none comes, nothing moves on.

    Parameters
    ----------
    name : str
        What errors call it.
    settings : DriveSettings
        The drive.
    link : CanLink
        The bus, shared by all axes.
    period : float
        Of the SYNC [s].
    watchdog : float
        How long the drive goes without the computer's heartbeat [s].
    """

    def __init__(
        self, name: str, settings: DriveSettings, link: CanLink, *, period: float, watchdog: float
    ) -> None:
        self._name = name
        self._settings = settings
        self.actuated = settings.actuated
        self._link = link
        self._period = period
        self._watchdog = watchdog
        self.monitor = DriveMonitor(link, settings.node_id)
        self._watch = TransitionWatch()
        self._configured = False
        self._opening = 0
        self._goal = Goal.OFF
        self._goal_cycles = 0
        self._recovering = False
        self._stopping = False
        self._mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self._sent_mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self._homing = Homing.NONE
        self._homing_cycles = 0
        self._stale_attained = False
        self._homed = False
        self._origin = 0
        self._zero = 0
        self._target = 0
        self._at: Feedback = self.monitor.feedback
        self._velocity = 0.0
        self._still = 0
        self._latched: Fault | None = None

    def probe(self) -> None:
        """Ask the drive whether it is there.

        Raises
        ------
        AxisError
            If it does not answer.
        """
        try:
            ObjectAccess(self._link, self._settings.node_id).read(od.DEVICE_TYPE)
        except (LinkError, DriveError) as error:
            raise self._error(error) from error

    # ---- orders -------------------------------------------------------------------------------

    def configure(self) -> None:
        """Open the link and set the drive up; moves nothing."""
        try:
            self._link.open()
            self._set_up(survived=False)
        except (LinkError, DriveError) as error:
            raise self._error(error) from error
        self._configured = True

    def power(self, on: bool) -> None:
        """Begin to switch the drive on, where it stands, or off."""
        if not self.actuated:
            return
        if on:
            self._refuse_fault()
        else:
            self._homing = Homing.NONE
            self._mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self._want(Goal.ON if on else Goal.OFF)

    def home(self, speed: float) -> None:
        """Begin to home; an axis that a hand moves takes where it is as 0."""
        self._refuse_fault()
        if not self.actuated:
            self._zero = self._at.position
            self._count_from_home()
            return
        self._homed = False
        try:
            access = ObjectAccess(self._link, self._settings.node_id)
            write_limits(access, self._settings, homed=False)
            write_homing(access, self._settings, speed)
        except (LinkError, DriveError) as error:
            raise self._error(error) from error
        self._mode = Mode.HOMING
        self._homing = Homing.PREPARING
        self._homing_cycles = 0

    def start_move(self, target: float, speed: float) -> None:
        """Set the set-point of the next cycle; `speed` follows from the cycle's length."""
        self._refuse_fault()
        if not self._ready:
            raise AxisError(f"{self._name} axis is not ready to move")
        settings = self._settings
        counts = settings.counts(target)
        lower, upper = settings.limits_counts
        if self._homed and not lower <= counts <= upper:
            raise AxisError(
                f"{self._name} axis: target {target:.6g} is outside the drive's limits "
                f"[{settings.lower:.6g}, {settings.upper:.6g}]",
                Rule.SOFTWARE_LIMITS,
            )
        step = abs(counts - self._target)
        bound = settings.magnitude(settings.speed * self._period * 1.01) + 1
        if step > bound:
            raise AxisError(
                f"{self._name} axis: set-point {step / settings.counts_per_unit:.6g} ahead in a "
                f"cycle at {speed:.6g}/s, at most {bound / settings.counts_per_unit:.6g}",
                Rule.LOOK_AHEAD,
            )
        self._target = counts

    def stop(self) -> None:
        """Order a quick stop now, without waiting for the next cycle."""
        if not self.actuated or not self._configured:
            return
        self._homing = Homing.NONE
        if self._goal is not Goal.OFF:
            self._want(Goal.STOPPED)
        self._stopping = True
        try:
            self._command(DriveCommand.QUICK_STOP)
        except LinkError as error:
            raise self._error(error) from error

    def reset(self) -> None:
        """Open a lost link, set a rebooted drive up again, acknowledge its fault; moves nothing."""
        self._want(Goal.OFF)
        self._homing = Homing.NONE
        self._stopping = False
        try:
            self._link.open()
            survived = self._survived()
            if not survived or self._opening != self._link.openings:
                self._set_up(survived=survived)
            self._reset_fault()
            self._latched = None
            self._watch.forget()
            self._refresh()
        except (LinkError, DriveError) as error:
            raise self._error(error) from error

    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest reply."""
        at = self._at
        fault = self._fault
        return AxisSnapshot(
            time=self.monitor.fresh_time,
            position=self._settings.position(at.position - self._zero),
            velocity=self._velocity,
            powered=not self.actuated or self._is_powered,
            homed=self._homed and not self.monitor.rebooted,
            moving=self._homing is not Homing.NONE,
            at_home_switch=bool(at.inputs & self._outer_switches),
            fault="" if fault is None else fault[1],
            fault_rule=Rule.ONE_FAULT_STOPS_BOTH if fault is None else fault[0],
            ready=not self.actuated or self._ready,
            origin=self._origin,
        )

    def close(self) -> None:
        """Stop, switch off and release the drive's watchdog; the link is its owner's to close."""
        if not self._configured:
            return
        self._homing = Homing.NONE
        try:
            self._want(Goal.OFF)
            self._switch_off_now()
            disarm_watchdog(self._link, self._settings)
        except (LinkError, DriveError) as error:
            raise self._error(error) from error
        finally:
            self._configured = False

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def needs_cycles(self) -> bool:
        """Whether the drive is on its way to a goal."""
        if not self.actuated or self._fault is not None:
            return False
        if self._goal is Goal.ON:
            return not self._ready or self._homing is not Homing.NONE
        return self._state in POWERED and not (
            self._goal is Goal.STOPPED and self._state is DriveState.QUICK_STOP_ACTIVE
        )

    def transmit(self) -> None:
        """Send this cycle's command and set-point.

        Raises
        ------
        LinkError
            If the link is lost.
        """
        if not self.actuated or not self._configured:
            return
        self._command(self._next_command())
        self._link.send(
            od.SET_POINT.function_code + self._settings.node_id, od.SET_POINT.pack(self._target)
        )

    def update(self) -> None:
        """Take what the drive answered to the SYNC; nothing new where nothing came."""
        before, at = self._at, self.monitor.feedback
        if at.number == before.number or not self._configured:
            return
        self._at = at
        self._velocity = self._settings.position(at.position - before.position) / self._period
        if not self.actuated:
            return
        still = abs(at.position - before.position) <= self._settings.magnitude(
            self._settings.tolerance
        )
        self._still = self._still + 1 if still else 0
        state = self._state
        if state is None:
            self._latch(f"statusword 0x{at.statusword:04X} is none of CiA 402's")
            return
        odd = self._watch.unexplained(state)
        if odd:
            self._latch(odd)
        follows = at.mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        if self._stopping or not (follows and state is DriveState.OPERATION_ENABLED):
            # Whatever switches on or changes mode begins where the axis stands.
            self._target = at.position
        # Until the drive has said that it took the stop, it counts as on its way there.
        self._stopping = self._stopping and state is DriveState.OPERATION_ENABLED
        self._goal_cycles += 1
        self._watch_switching(state)
        if self._homing is not Homing.NONE:
            self._go_home(state)

    def _watch_switching(self, state: DriveState) -> None:
        if self._ready or self._homing is Homing.RUNNING:
            self._goal_cycles = 0
            self._recovering = False
            return
        if self._goal is Goal.ON:
            stuck = state is DriveState.QUICK_STOP_ACTIVE and self._still > _REST
            if stuck and self._goal_cycles > _LONGEST_REENABLE + _REST:
                # Transition 16 is optional: where it is lacking, through SWITCH ON DISABLED.
                self._recovering = True
            switching = True
        else:
            switching = state is DriveState.OPERATION_ENABLED or (
                self._goal is Goal.OFF and state in POWERED
            )
        if switching and self._goal_cycles > _LONGEST_SWITCHING:
            seconds = _LONGEST_SWITCHING * self._period
            self._latch(
                f"is not {self._goal.value} after {seconds:g} s: state {state.name}, "
                f"mode {self._at.mode}"
            )

    def _next_command(self) -> DriveCommand:
        state = self._state
        if self._stopping:
            return DriveCommand.QUICK_STOP
        if self._goal is not Goal.ON:
            at_rest = self._still >= _REST or self._goal_cycles > _LONGEST_REST
            return next_command(self._goal, state, at_rest=at_rest)
        at_rest = self._still >= _REST
        if state is DriveState.QUICK_STOP_ACTIVE and self._recovering:
            return DriveCommand.DISABLE_VOLTAGE
        if self._at.mode != self._mode:
            if state in POWERED:
                return next_command(Goal.OFF, state, at_rest=at_rest)
            if state is DriveState.SWITCHED_ON:
                return DriveCommand.SWITCH_ON
        return next_command(Goal.ON, state, at_rest=at_rest)

    def _command(self, command: DriveCommand) -> None:
        # The mode of a powered drive stays: its set-point may be of another mode's making.
        if self._state not in POWERED:
            self._sent_mode = self._mode
        word = int(command)
        if self._homing is Homing.RUNNING and command is DriveCommand.ENABLE_OPERATION:
            word |= START_HOMING
        self._watch.sent(command)
        self._link.send(
            od.COMMAND.function_code + self._settings.node_id,
            od.COMMAND.pack(word, self._sent_mode),
        )

    def _go_home(self, state: DriveState) -> None:
        at = self._at
        attained = bool(at.statusword & HOMING_ATTAINED)
        self._homing_cycles += 1
        if self._homing is Homing.PREPARING:
            if state is DriveState.OPERATION_ENABLED and at.mode == Mode.HOMING:
                # A drive may still say that it attained the homing before.
                self._stale_attained = attained
                self._homing = Homing.RUNNING
                self._homing_cycles = 0
            return
        if at.statusword & HOMING_ERROR:
            self._latch("homing failed")
            return
        self._stale_attained = self._stale_attained and attained
        done = attained and bool(at.statusword & TARGET_REACHED) and not self._stale_attained
        if self._stale_attained and self._settings.homing_method in HERE:
            near = abs(at.position) <= self._settings.magnitude(self._settings.tolerance)
            done = near and self._homing_cycles >= _INSTANT_HOMING
        if done:
            self._end_homing()

    def _end_homing(self) -> None:
        try:
            write_limits(
                ObjectAccess(self._link, self._settings.node_id), self._settings, homed=True
            )
        except LinkError:
            return
        except DriveError as error:
            self._latch(str(error))
            return
        self._count_from_home()

    def _count_from_home(self) -> None:
        self._homing = Homing.NONE
        self._homed = True
        self._origin += 1

    # ---- what is the matter -------------------------------------------------------------------

    @property
    def _state(self) -> DriveState | None:
        return drive_state(self._at.statusword)

    @property
    def _ready(self) -> bool:
        return (
            self._goal is Goal.ON
            and not self._stopping
            and self._state is DriveState.OPERATION_ENABLED
            and self._at.mode == self._mode == Mode.CYCLIC_SYNCHRONOUS_POSITION
        )

    @property
    def _is_powered(self) -> bool:
        # A drive that is still on from before, on its way off or to another mode, is not.
        on = self._state in POWERED and self._at.mode == self._mode
        return self._goal is not Goal.OFF and (on or self._recovering)

    @property
    def _outer_switches(self) -> int:
        # Outward is the drive's positive direction where it counts in reverse.
        limit = od.POSITIVE_LIMIT_SWITCH if self._settings.reverse else od.NEGATIVE_LIMIT_SWITCH
        return limit | od.HOME_SWITCH

    @property
    def _fault(self) -> Fault | None:  # noqa: PLR0911 - each return is a fault
        if not self._configured:
            return None
        if self._link.lost:
            return Rule.LINK_LOSS, self._link.lost
        monitor = self.monitor
        if monitor.rebooted:
            return Rule.DRIVE_REBOOT, "the drive rebooted; its home position is lost"
        code = monitor.emergency
        if code is not None:
            rule = Rule.DRIVE_WATCHDOG if code == HEARTBEAT_LOST else Rule.DRIVE_EMERGENCY
            return rule, f"the drive reports {describe_error(code)}"
        state = self._state
        if state in FAULTS:
            return Rule.DRIVE_EMERGENCY, f"the drive is in {state.name}"
        if monitor.left_operational:
            return Rule.DRIVE_REBOOT, "the drive left the operational state"
        if self._latched is not None:
            return self._latched
        following = self._at.statusword & FOLLOWING_ERROR and self._ready
        if following:
            return Rule.FOLLOWING_ERROR, "the drive reports a following error"
        return None

    def _latch(self, text: str) -> None:
        if self._latched is None:
            self._latched = (Rule.ONE_FAULT_STOPS_BOTH, f"the drive {text}")

    def _refuse_fault(self) -> None:
        if not self._configured:
            raise AxisError(f"{self._name} axis is not configured")
        fault = self._fault
        if fault is not None:
            raise AxisError(f"{self._name} axis: {fault[1]}", fault[0])

    def _error(self, error: LinkError | DriveError) -> AxisError:
        rule = Rule.LINK_LOSS if isinstance(error, LinkError) else Rule.ONE_FAULT_STOPS_BOTH
        return AxisError(f"{self._name} axis: {error}", rule)

    def _want(self, goal: Goal) -> None:
        if goal is not self._goal:
            self._goal = goal
            self._goal_cycles = 0
            self._recovering = False

    # ---- set-up, reset, shut-down -------------------------------------------------------------

    def _set_up(self, *, survived: bool) -> None:
        if not survived:
            self._homed = False
            self._origin += 1
        self.monitor.begin_set_up()
        set_up(
            self._link,
            self._settings,
            period=self._period,
            homed=self._homed,
        )
        if not self._await_operational():
            raise DriveError(f"node {self._settings.node_id} did not become operational")
        arm_watchdog(self._link, self._settings, self._watchdog)
        self.monitor.end_set_up()
        self._opening = self._link.openings
        self._watch.forget()
        self._latched = None
        self._refresh()

    def _await_operational(self) -> bool:
        until = self._link.clock() + _HEARTBEAT_WAIT
        while self._link.clock() < until:
            send_heartbeat(self._link)
            if self.monitor.await_operational(self._period):
                return True
        return False

    def _survived(self) -> bool:
        return self._await_operational() and not self.monitor.rebooted

    def _reset_fault(self) -> None:
        access = ObjectAccess(self._link, self._settings.node_id)
        self.monitor.emergency = None
        if drive_state(access.read(od.STATUSWORD)) not in FAULTS:
            return
        # The rising edge counts.
        access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)
        access.write(od.CONTROLWORD, DriveCommand.FAULT_RESET)
        until = self._link.clock() + _FAULT_RESET_WAIT
        while drive_state(access.read(od.STATUSWORD)) in FAULTS:
            if self._link.clock() > until:
                code = describe_error(access.read(od.ERROR_CODE))
                raise DriveError(f"the drive does not leave its fault: {code}")
        access.write(od.CONTROLWORD, DriveCommand.DISABLE_VOLTAGE)

    def _refresh(self) -> None:
        access = ObjectAccess(self._link, self._settings.node_id)
        self.monitor.take(
            access.read(od.STATUSWORD),
            access.read(od.MODE_DISPLAY),
            self._at.inputs,
            access.read(od.POSITION_ACTUAL),
        )
        self._at = self.monitor.feedback
        self._target = self._at.position
        self._velocity = 0.0
        self._still = 0

    def _switch_off_now(self) -> None:
        """Run cycles of its own until the drive is off: nobody else will."""
        if not self.actuated:
            return
        silent = 0
        for _ in range(_LONGEST_REST + _REST):
            send_heartbeat(self._link)
            self._command(self._next_command())
            self.monitor.expect_answer()
            self._link.send(od.SYNC)
            with self._link.arrival:
                answered = self._link.arrival.wait_for(self.monitor.answered, self._period)
                # Not as fast as the bus goes: a drive has this cycle's length.
                self._link.arrival.wait_for(lambda: bool(self._link.lost), self._period / 2.0)
            self.update()
            silent = 0 if answered else silent + 1
            if self._state not in POWERED or silent > _SILENT:
                return
