"""Axis on a CiA 402 drive."""

from __future__ import annotations

from needle_device_driver.axes.axis import PERIOD, AxisSnapshot
from needle_device_driver.axes.drives import CyclicAxis
from needle_device_driver.axes.link import DriveError, raised_as_axis_error
from needle_device_driver.cia402.cia402 import (
    FAULTS,
    FOLLOWING_ERROR,
    POWERED,
    START_HOMING,
    DriveCommand,
    Goal,
    Mode,
)
from needle_device_driver.cia402.drive_machine import MAX_REST, DriveMachine
from needle_device_driver.cia402.drive_monitor import DriveMonitor
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.cia402.drive_setup import NO_INPUTS, set_up, write_homing, write_limits
from needle_device_driver.cia402.drive_upkeep import (
    StuckFaultError,
    arm_watchdog,
    await_operational,
    await_start,
    disarm_watchdog,
    reset_fault,
)
from needle_device_driver.cia402.homing_run import HomingRun, HomingStep
from needle_device_driver.link import objects as od
from needle_device_driver.link.error_codes import HEARTBEAT_LOST, describe_error
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.object_access import ObjectAccess
from needle_device_driver.procedure import Procedure, Wait
from needle_device_driver.rules import Problem, Rule

# Number of cycles without an answer after which `close` stops waiting for the drive.
_MAX_SILENT = 15


class Cia402Axis(CyclicAxis):
    """Axis on one drive in cyclic synchronous position mode.

    In each cycle, `transmit` sends the next command and set-point before the SYNC, and `update`
    handles the answer.

    Parameters
    ----------
    name : str
        Name in error messages.
    settings : DriveSettings
        The drive.
    link : FrameLink
        The bus, shared by all axes.
    watchdog : float
        Time without the computer's heartbeat after which the drive stops [s].

    Attributes
    ----------
    monitor : DriveMonitor
        Receives the frames of the drive.
    missing_optional_objects : tuple of str
        Optional objects that the drive lacks.
    """

    # Includes the units of the drive after its set-up.
    _settings: DriveSettings
    _link: FrameLink
    _homing: HomingRun | None
    _counter = od.NO_LIMITS[0]

    def __init__(
        self, name: str, settings: DriveSettings, link: FrameLink, watchdog: float
    ) -> None:
        super().__init__(name, settings, link)
        self._given, self._watchdog = settings, watchdog
        self.monitor = DriveMonitor(link, settings.node_id)
        self.missing_optional_objects: tuple[str, ...] = ()
        rest, stop_time = settings.magnitude(settings.tolerance), settings.stop_time
        self._machine = DriveMachine(rest, PERIOD, stop_time, self.monitor.feedback)

    @property
    def node_id(self) -> int:
        """CANopen node id of the drive."""
        return self._settings.node_id

    def probe(self) -> Procedure[None]:
        """Check that the drive answers, in any state of its node.

        Raises
        ------
        AxisError
            If it does not answer.
        """
        node = self._settings.node_id
        with raised_as_axis_error(self.name):
            # A node in the state "stopped" answers no SDO.
            self._link.send(od.NMT, bytes([od.NMT_PRE_OPERATIONAL, node]))
            yield from ObjectAccess(self._link, node).read(od.DEVICE_TYPE)

    # ---- orders -------------------------------------------------------------------------------

    def power(self, on: bool) -> None:
        """Begin to switch the drive on, without motion, or off."""
        if not self.actuated:
            return
        if on:
            self._refuse_power()
        else:
            self._homing = None
            self._machine.mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self._machine.set_goal(Goal.ON if on else Goal.OFF)

    def home(self, speed: float) -> Procedure[None]:
        """Begin homing; without a motor, the present position becomes 0."""
        self._refuse_fault()
        if not self.actuated:
            self._count_from_home(self._machine.at.position)
            return
        self._homed = self._limits_due = False
        with raised_as_axis_error(self.name):
            yield from write_limits(self._access, self._settings, homed=False)
            yield from write_homing(self._access, self._settings, speed)
        self._machine.mode = Mode.HOMING
        has_inputs = NO_INPUTS not in self.missing_optional_objects
        self._homing = HomingRun(self._settings, speed, has_inputs=has_inputs)

    def start_move(self, target: float, speed: float) -> None:
        """Set the set-point of the next cycle; it implies the speed."""
        machine = self._machine
        counts = self._check_move(target, speed, machine.target)
        step, machine.target = abs(counts - machine.target), counts
        self._speed.command(step / self._settings.counts_per_unit / PERIOD)

    def stop(self) -> None:
        """Send a quick stop immediately."""
        if not self.actuated or not self._configured:
            return
        self._machine.stop()
        with raised_as_axis_error(self.name):
            self._send_order()

    def reset(self) -> Procedure[None]:
        """Open a lost link, set up a rebooted drive, acknowledge a fault; moves nothing."""
        self._machine.set_goal(Goal.OFF)
        self._homing = None
        with raised_as_axis_error(self.name):
            self._link.open()
            self._link.other_master = ""
            operational = yield from await_operational(self._link, self.monitor, PERIOD)
            survived = operational and not self.monitor.rebooted
            if not survived or self._opening != self._link.openings:
                yield from self._set_up(survived=survived)
            self.monitor.emergency = None
            try:
                yield from reset_fault(self._link, self._settings)
            except StuckFaultError:
                # Frames of the set-up may be lost: make the next reset repeat it.
                self._opening = 0
                raise
            yield from self._refresh()

    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest feedback."""
        machine = self._machine
        return self._snapshot(
            machine.at.position,
            machine.target if self.actuated else machine.at.position,
            time=self.monitor.fresh_since,
            powered=not self.actuated or machine.powered,
            homed=self._homed and not self.monitor.rebooted,
            at_home_switch=bool(machine.at.inputs & self._settings.outer_switches),
            at_inner_switch=bool(machine.at.inputs & self._settings.inner_switch),
            ready=not self.actuated or machine.ready,
            answered=self.monitor.answered(),
            released_after_block=machine.released_after_block,
            stop_failure=machine.stop_failure,
        )

    def close(self) -> Procedure[None]:
        """Stop, switch off and disarm the drive's watchdog; the caller closes the link.

        Raises
        ------
        AxisError
            If the drive does not report that it is off: its watchdog, still armed, switches it off.
        """
        if not self._configured:
            return
        self._homing = None
        try:
            with raised_as_axis_error(self.name):
                self._machine.set_goal(Goal.OFF)
                if not (yield from self._switch_off_now()):
                    raise DriveError("does not confirm power-off; its watchdog will switch it off")
                yield from disarm_watchdog(self._link, self._settings)
        finally:
            self._configured = False

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def needs_cycles(self) -> bool:
        """Whether the drive still executes an order other than a set-point."""
        if not self.actuated or self._fault is not None:
            return False
        return self._machine.switching or self._homing is not None or self._limits_due

    def transmit(self) -> Procedure[None]:
        """Send this cycle's command and set-point; raises `LinkError` if the link is lost."""
        if not self.actuated or not self._configured:
            return
        if self._limits_due and self._machine.state not in POWERED:
            # Before the SYNC: the drive may be slow, and its next feedback must be fresh.
            yield from self._write_limits()
        self._send_order()
        self._link.send(
            od.SET_POINT.function_code + self._settings.node_id,
            od.SET_POINT.pack(self._machine.target),
        )

    def update(self) -> None:
        """Handle the drive's answer to the SYNC, if there is one."""
        before, at = self._machine.at, self.monitor.feedback
        if at.number == before.number or not self._configured:
            return
        self._velocity = self._settings.position(at.position - before.position) / PERIOD
        if not self.actuated:
            self._machine.at = at
            return
        self._machine.update(at)
        if self._homing is not None:
            self._speed.command(self._homing.speed)
        periods = at.periods_since(before, PERIOD)
        moved = self._settings.position(at.position - before.position)
        plausible = self._speed.check(moved, periods, powered=self._machine.state in POWERED)
        if self._homing is not None:
            self._homing.update(at, at.position - before.position if plausible else 0)
            if self._homing.step is HomingStep.DONE:
                self._count_from_home()

    def _send_order(self) -> None:
        command, mode = self._machine.next_order()
        word = int(command)
        running = self._homing is not None and self._homing.step is HomingStep.RUNNING
        if running and command is DriveCommand.ENABLE_OPERATION:
            word |= START_HOMING
        self._link.send(
            od.COMMAND.function_code + self._settings.node_id, od.COMMAND.pack(word, mode)
        )

    def _write_limits(self) -> Procedure[None]:
        try:
            yield from write_limits(self._access, self._settings, homed=True)
        except DriveError as error:
            self._machine.problem = str(error)
            return
        self._limits_due = False

    @property
    def _access(self) -> ObjectAccess:
        return ObjectAccess(self._link, self._settings.node_id)

    @property
    def _fault(self) -> Problem | None:  # noqa: PLR0911 - each return is a fault
        monitor, machine, homing = self.monitor, self._machine, self._homing
        if self._link.lost:
            return Problem(Rule.LINK_LOSS, self._link.lost)
        if self._link.other_master:
            return Problem(Rule.ONE_MASTER, self._link.other_master)
        if self._speed.problem:
            return Problem(Rule.AXIS_SPEED, self._speed.problem)
        if monitor.rebooted:
            return Problem(Rule.DRIVE_REBOOT, "the drive rebooted; its home position is lost")
        if (code := monitor.emergency) is not None:
            rule = Rule.DRIVE_WATCHDOG if code == HEARTBEAT_LOST else Rule.DRIVE_EMERGENCY
            return Problem(rule, f"the drive reports {describe_error(code)}")
        state = machine.state
        # Without a motor the drive may be in any state.
        if self.actuated and state is not None and state in FAULTS:
            return Problem(Rule.DRIVE_EMERGENCY, f"the drive is in {state.name}")
        if monitor.left_operational:
            return Problem(Rule.DRIVE_REBOOT, "the drive left the operational state")
        if machine.problem:
            return Problem(Rule.ONE_FAULT_STOPS_BOTH, f"the drive {machine.problem}")
        if homing is not None and homing.problem:
            failed = homing.step is HomingStep.FAILED
            rule = Rule.ONE_FAULT_STOPS_BOTH if failed else Rule.HOMING_TIME
            return Problem(rule, f"the drive {homing.problem}")
        if machine.ready and machine.at.statusword & FOLLOWING_ERROR:
            return Problem(Rule.FOLLOWING_ERROR, "the drive reports a following error")
        return None

    # ---- set-up, reset, shut-down -------------------------------------------------------------

    def _set_up(self, *, survived: bool = False) -> Procedure[None]:
        self._link.open()
        self._homed = self._homed and survived
        self.monitor.begin_set_up()
        self._settings, self.missing_optional_objects = yield from set_up(
            self._link, self.monitor, self._given, period=PERIOD, homed=self._homed
        )
        self._limits_due = False
        yield from await_start(self._link, self.monitor, self._settings, PERIOD)
        yield from arm_watchdog(self._link, self._settings, self._watchdog)
        if self.monitor.rebooted:
            # The reboot undid the first part of the set-up.
            raise DriveError(f"node {self._settings.node_id} rebooted during set-up")
        self.monitor.end_set_up()
        self._opening = self._link.openings
        yield from self._refresh()

    def _refresh(self) -> Procedure[None]:
        """Read the process data by SDO, and discard the earlier state."""
        access = self._access
        self.monitor.set_feedback(
            (yield from access.read(od.STATUSWORD)),
            (yield from access.read(od.MODE_DISPLAY)),
            self._machine.at.inputs,
            (yield from access.read(od.POSITION_ACTUAL)),
        )
        self._machine.restart(self.monitor.feedback)
        self._restart_feedback()
        if self._machine.state in FAULTS:
            # The emergency message of an earlier fault was not received.
            self.monitor.emergency = (yield from access.read_optional(od.ERROR_CODE)) or None

    def _switch_off_now(self) -> Procedure[bool]:
        """Run separate cycles until the drive is off; return whether it is."""
        if not self.actuated:
            return True
        silent = 0
        for _ in range(MAX_REST + _MAX_SILENT):
            self._link.beat()
            self._send_order()
            self.monitor.expect_answer()
            self._link.send(od.SYNC)
            yield Wait(self.monitor.answered, PERIOD)
            answered = self.monitor.answered()
            # A drive needs about one period between two SYNCs.
            yield Wait(lambda: bool(self._link.lost), PERIOD / 2.0)
            self.update()
            silent = 0 if answered else silent + 1
            if silent > _MAX_SILENT:
                return False
            if answered and self._machine.state not in POWERED:
                return True
        return False
