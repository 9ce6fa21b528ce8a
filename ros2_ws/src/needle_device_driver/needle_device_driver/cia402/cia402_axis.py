"""An axis whose drive speaks CiA 402 over CAN."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from needle_device_driver.axes.axis import Axis, AxisError, AxisSnapshot
from needle_device_driver.cia402.axis_speed import SpeedWatch
from needle_device_driver.cia402.cia402 import (
    FAULTS,
    POWERED,
    START_HOMING,
    DriveCommand,
    Goal,
    Mode,
)
from needle_device_driver.cia402.drive_fault import Fault, drive_fault
from needle_device_driver.cia402.drive_machine import LONGEST_REST, DriveMachine
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
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.link.object_access import DriveError, ObjectAccess
from needle_device_driver.procedure import Procedure, Wait
from needle_device_driver.rules import Rule

# In cycles without an answer: a drive that is switched off at the end is given up.
_SILENT = 15


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
    link : FrameLink
        The bus, shared by all axes.
    period : float
        Of the SYNC [s].
    watchdog : float
        How long the drive goes without the computer's heartbeat [s].

    Attributes
    ----------
    name : str
        As given.
    monitor : DriveMonitor
        What the drive sends.
    missing_optional_objects : tuple of str
        What the drive lacks that it could be set up without.
    """

    def __init__(
        self, name: str, settings: DriveSettings, link: FrameLink, *, period: float, watchdog: float
    ) -> None:
        self.name = name
        # As given, and with the units that the drive tells.
        self._given = self._settings = settings
        self.actuated = settings.actuated
        self._link, self._period, self._watchdog = link, period, watchdog
        self.monitor = DriveMonitor(link, settings.node_id)
        self.missing_optional_objects: tuple[str, ...] = ()
        rest, stop_time = settings.magnitude(settings.tolerance), settings.stop_time
        self._machine = DriveMachine(rest, period, stop_time, self.monitor.feedback)
        self._speed = SpeedWatch(settings, period)
        self._homing: HomingRun | None = None
        self._configured = self._homed = self._limits_due = False
        self._opening = self._origin = self._zero = 0
        self._velocity = 0.0

    def probe(self) -> Procedure[None]:
        """Ask the drive whether it is there, from whatever state its node was left in.

        Raises
        ------
        AxisError
            If it does not answer.
        """
        node = self._settings.node_id
        with self._as_axis_error():
            # A stopped node answers to nothing else.
            self._link.send(od.NMT, bytes([od.NMT_PRE_OPERATIONAL, node]))
            yield from ObjectAccess(self._link, node).read(od.DEVICE_TYPE)

    # ---- orders -------------------------------------------------------------------------------

    def configure(self) -> Procedure[None]:
        """Open the link and set the drive up; moves nothing."""
        with self._as_axis_error():
            self._link.open()
            yield from self._set_up(survived=False)
        self._configured = True

    def power(self, on: bool) -> None:
        """Begin to switch the drive on, where it stands, or off."""
        if not self.actuated:
            return
        if on:
            self._refuse_fault()
            if self._limits_due:
                raise AxisError(f"{self.name} axis has no software limits yet")
        else:
            self._homing = None
            self._machine.mode = Mode.CYCLIC_SYNCHRONOUS_POSITION
        self._machine.want(Goal.ON if on else Goal.OFF)

    def home(self, speed: float) -> Procedure[None]:
        """Begin to home; an axis that a hand moves takes where it is as 0."""
        self._refuse_fault()
        if not self.actuated:
            self._zero = self._machine.at.position
            self._count_from_home()
            return
        self._homed = self._limits_due = False
        with self._as_axis_error():
            yield from write_limits(self._access, self._settings, homed=False)
            yield from write_homing(self._access, self._settings, speed)
        self._machine.mode = Mode.HOMING
        switches = NO_INPUTS not in self.missing_optional_objects
        self._homing = HomingRun(self._settings, speed, switches=switches)

    def start_move(self, target: float, speed: float) -> None:
        """Set the set-point of the next cycle; `speed` follows from the cycle's length."""
        self._refuse_fault()
        if not self._machine.ready:
            raise AxisError(f"{self.name} axis is not ready to move")
        settings = self._settings
        counts = settings.counts(target)
        lower, upper = settings.limits_counts if self._homed else od.NO_LIMITS[0]
        if not lower <= counts <= upper:
            # How a drive goes on beyond its last count is its own: on, back all the way, or not.
            raise AxisError(
                f"{self.name} axis: target {target:.6g} is outside the drive's "
                f"{settings.limits if self._homed else 'counter; home it, or set it nearer 0'}",
                Rule.SOFTWARE_LIMITS,
            )
        step = abs(counts - self._machine.target)
        bound = settings.magnitude(settings.speed * self._period * 1.01) + 1
        if step > bound:
            raise AxisError(
                f"{self.name} axis: set-point {step / settings.counts_per_unit:.6g} ahead in a "
                f"cycle at {speed:.6g}/s, at most {bound / settings.counts_per_unit:.6g}",
                Rule.LOOK_AHEAD,
            )
        self._machine.target = counts
        self._speed.command(step / settings.counts_per_unit / self._period)

    def stop(self) -> None:
        """Order a quick stop now, without waiting for the next cycle."""
        if not self.actuated or not self._configured:
            return
        self._homing = None
        self._machine.stop()
        with self._as_axis_error():
            self._send_order()

    def reset(self) -> Procedure[None]:
        """Open a lost link, set a rebooted drive up again, acknowledge its fault; moves nothing."""
        self._machine.want(Goal.OFF)
        self._homing = None
        with self._as_axis_error():
            self._link.open()
            self._link.other_master = ""
            operational = yield from await_operational(self._link, self.monitor, self._period)
            survived = operational and not self.monitor.rebooted
            if not survived or self._opening != self._link.openings:
                yield from self._set_up(survived=survived)
            self.monitor.emergency = None
            try:
                yield from reset_fault(self._link, self._settings)
            except StuckFaultError:
                # What it was told in its set-up may have got lost: the next reset tells it again.
                self._opening = 0
                raise
            yield from self._refresh()

    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest reply."""
        machine, fault = self._machine, self._fault
        position = self._settings.position(machine.at.position - self._zero)
        told = self._settings.position(machine.target - self._zero)
        return AxisSnapshot(
            time=self.monitor.fresh_time,
            position=position,
            set_point=told if self.actuated else position,
            velocity=self._velocity,
            powered=not self.actuated or machine.powered,
            homed=self._homed and not self.monitor.rebooted,
            moving=self._homing is not None,
            at_home_switch=bool(machine.at.inputs & self._settings.outer_switches),
            at_inner_switch=bool(machine.at.inputs & self._settings.inner_switch),
            fault="" if fault is None else fault[1],
            fault_rule=Rule.ONE_FAULT_STOPS_BOTH if fault is None else fault[0],
            ready=not self.actuated or machine.ready,
            answered=self.monitor.answered(),
            let_go=machine.let_go,
            unstopped=machine.unstopped,
            origin=self._origin,
        )

    def close(self) -> Procedure[None]:
        """Stop, switch off and release the drive's watchdog; the link is its owner's to close.

        Raises
        ------
        AxisError
            If the drive does not say that it is off: its watchdog stays, and will switch it off.
        """
        if not self._configured:
            return
        self._homing = None
        try:
            with self._as_axis_error():
                self._machine.want(Goal.OFF)
                if not (yield from self._switch_off_now()):
                    raise DriveError("does not say that it is off; its watchdog will switch it off")
                yield from disarm_watchdog(self._link, self._settings)
        finally:
            self._configured = False

    # ---- the cycle ----------------------------------------------------------------------------

    @property
    def needs_cycles(self) -> bool:
        """Tell whether the drive is on its way to where it was ordered, apart from set-points."""
        if not self.actuated or self._fault is not None:
            return False
        return self._machine.switching or self._homing is not None or self._limits_due

    def transmit(self) -> Procedure[None]:
        """Send this cycle's command and set-point.

        Raises
        ------
        LinkError
            If the link is lost.
        """
        if not self.actuated or not self._configured:
            return
        if self._limits_due and self._machine.state not in POWERED:
            # Before the SYNC: a drive may take its time, and is then judged by a fresh answer.
            yield from self._write_limits()
        self._send_order()
        self._link.send(
            od.SET_POINT.function_code + self._settings.node_id,
            od.SET_POINT.pack(self._machine.target),
        )

    def update(self) -> None:
        """Take what the drive answered to the SYNC; nothing new where nothing came."""
        before, at = self._machine.at, self.monitor.feedback
        if at.number == before.number or not self._configured:
            return
        self._velocity = self._settings.position(at.position - before.position) / self._period
        if not self.actuated:
            self._machine.at = at
            return
        self._machine.update(at)
        if self._homing is not None:
            self._speed.command(self._homing.speed)
        plausible = self._speed.judge(before, at, powered=self._machine.state in POWERED)
        if self._homing is not None:
            self._homing.update(at, at.position - before.position if plausible else 0)
            if self._homing.step is HomingStep.DONE:
                # The drive's own limits count from home: now that it has one, and once it is off.
                self._limits_due = True
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
        except LinkError:
            return  # its loss has a name of its own
        except DriveError as error:
            self._machine.trouble = str(error)
            return
        self._limits_due = False

    def _count_from_home(self) -> None:
        self._homing, self._homed = None, True
        self._origin += 1

    # ---- what is the matter -------------------------------------------------------------------

    @property
    def _access(self) -> ObjectAccess:
        return ObjectAccess(self._link, self._settings.node_id)

    @property
    def _fault(self) -> Fault | None:
        if not self._configured:
            return None
        if self._link.lost:
            return Rule.LINK_LOSS, self._link.lost
        if self._link.other_master:
            return Rule.ONE_MASTER, self._link.other_master
        watched = self.monitor, self._machine, self._speed, self._homing
        return drive_fault(*watched, actuated=self.actuated)

    def _refuse_fault(self) -> None:
        if not self._configured:
            raise AxisError(f"{self.name} axis is not configured")
        if (fault := self._fault) is not None:
            raise AxisError(f"{self.name} axis: {fault[1]}", fault[0])

    @contextlib.contextmanager
    def _as_axis_error(self) -> Iterator[None]:
        """Raise what goes wrong with link or drive as the axis' own error."""
        try:
            yield
        except (LinkError, DriveError) as error:
            rule = Rule.LINK_LOSS if isinstance(error, LinkError) else Rule.ONE_FAULT_STOPS_BOTH
            raise AxisError(f"{self.name} axis: {error}", rule) from error

    # ---- set-up, reset, shut-down -------------------------------------------------------------

    def _set_up(self, *, survived: bool) -> Procedure[None]:
        self._homed = self._homed and survived
        self.monitor.begin_set_up()
        self._settings, self.missing_optional_objects = yield from set_up(
            self._link, self.monitor, self._given, period=self._period, homed=self._homed
        )
        self._limits_due = False
        yield from await_start(self._link, self.monitor, self._settings, self._period)
        yield from arm_watchdog(self._link, self._settings, self._watchdog)
        if self.monitor.rebooted:
            # What it was told before is gone.
            raise DriveError(f"node {self._settings.node_id} started anew while it was set up")
        self.monitor.end_set_up()
        self._opening = self._link.openings
        yield from self._refresh()

    def _refresh(self) -> Procedure[None]:
        """Ask for what the next SYNC would bring, and forget what was before."""
        access = self._access
        self.monitor.take(
            (yield from access.read(od.STATUSWORD)),
            (yield from access.read(od.MODE_DISPLAY)),
            self._machine.at.inputs,
            (yield from access.read(od.POSITION_ACTUAL)),
        )
        self._machine.begin_anew(self.monitor.feedback)
        # From one reading to the next it may count from elsewhere.
        self._origin += 1
        self._speed.forget()
        self._velocity = 0.0
        if self._machine.state in FAULTS:
            # A fault from before has sent its message to nobody.
            self.monitor.emergency = (yield from access.ask(od.ERROR_CODE)) or None

    def _switch_off_now(self) -> Procedure[bool]:
        """Run cycles of its own until the drive is off: nobody else will. Return whether it is."""
        if not self.actuated:
            return True
        silent = 0
        for _ in range(LONGEST_REST + _SILENT):
            self._link.beat()
            self._send_order()
            self.monitor.expect_answer()
            self._link.send(od.SYNC)
            yield Wait(self.monitor.answered, self._period)
            answered = self.monitor.answered()
            # Not as fast as the bus goes: a drive has this cycle's length.
            yield Wait(lambda: bool(self._link.lost), self._period / 2.0)
            self.update()
            silent = 0 if answered else silent + 1
            if silent > _SILENT:
                return False
            if answered and self._machine.state not in POWERED:
                return True
        return False
