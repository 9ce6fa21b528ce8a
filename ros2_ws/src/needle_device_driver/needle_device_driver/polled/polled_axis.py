"""Axis on a drive that answers requests."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable

from needle_device_driver.axes.axis import PERIOD, AxisSnapshot
from needle_device_driver.axes.axis_settings import PRESENT_POSITION_METHODS, AxisSettings
from needle_device_driver.axes.drives import CyclicAxis
from needle_device_driver.axes.link import DriveError, raised_as_axis_error
from needle_device_driver.polled.drive_protocol import DriveProtocol, DriveReply
from needle_device_driver.procedure import Procedure, Wait
from needle_device_driver.rules import Problem, Rule

# An axis is at rest after this number of cycles without motion.
_REST = 3
# An axis that is still moving this number of cycles after its stop ramp is switched off.
_STOP_MARGIN = 8
# A drive that takes longer to switch on or off has failed [cycles].
_MAX_SWITCHING = 100
# An axis leaves its switch at this share of the homing speed: the edge of the switch is home.
_EDGE_SPEED = 0.1
# A stopped axis farther than this from its set-point is blocked [cycles at full speed].
_BLOCKED = 1.5
_CONFLICT = "the drive missed an order of this computer, or received one of another program"
_OFF = DriveReply(0, moving=False, powered=False)


class _Homing(enum.Enum):
    SEARCH = "search"
    SETTLE = "settle"
    LEAVE = "leave"


class PolledAxis(CyclicAxis):
    """Axis on one drive of a `DriveProtocol`.

    In each cycle, `transmit` sends the next order, and `update` handles the answer. Homing also
    consists of set-points.

    Parameters
    ----------
    name : str
        Insertion or rotation.
    settings : AxisSettings
        Settings of the axis.
    protocol : DriveProtocol
        Protocol of the drive.
    refresh : callable
        Returns a procedure that requests the state of the drive and waits for it.
    """

    _homing: _Homing | None

    def __init__(
        self,
        name: str,
        settings: AxisSettings,
        protocol: DriveProtocol,
        refresh: Callable[[], Procedure[None]],
    ) -> None:
        super().__init__(name, settings, protocol.link)
        self._protocol, self._refresh = protocol, refresh
        response = math.ceil(protocol.capabilities.response_time / PERIOD)
        self._max_stop = math.ceil(settings.stop_time / PERIOD) + response + _STOP_MARGIN
        self._at = _OFF
        self._time = -math.inf
        self._target = self._last_target = 0
        self._goal_on = self._stopping = self._released = False
        self._was_off = self._was_ready = False
        self._set_point_speed: int | None = None
        self._homing_speed = self._travelled = 0.0
        self._still = self._cycles = self._order_cycles = 0
        self._problem: Problem | None = None
        self.answered = True

    # ---- orders -------------------------------------------------------------------------------

    def power(self, on: bool) -> None:
        """Begin to switch the drive on, without motion, or off as soon as it is at rest."""
        if on:
            self._refuse_power()
        else:
            self._homing = None
        if on is not self._goal_on or self._released:
            self._goal_on, self._cycles = on, 0
        self._was_off = self._released = False

    def home(self, speed: float) -> Procedure[None]:
        """Begin homing: search for the outer switch, and leave it slowly."""
        self._refuse_fault()
        self._homed = self._limits_due = False
        self._homing, self._homing_speed, self._travelled = _Homing.SEARCH, speed, 0.0
        yield from ()

    def start_move(self, target: float, speed: float) -> None:
        """Set the set-point of the next cycle; it implies the speed."""
        counts = self._check_move(target, speed, self._target)
        if counts != self._target:
            # A repeated set-point would replace the drive's unfinished order with a slower one.
            step = abs(counts - self._target)
            self._move_to(counts, step / self._settings.counts_per_unit / PERIOD)

    def stop(self) -> None:
        """Send a stop immediately."""
        if not self._configured:
            return
        self._homing, self._set_point_speed = None, None
        self._stopping, self._order_cycles, self._still = True, 0, 0
        self._last_target = self._target
        with raised_as_axis_error(self.name):
            self._protocol.stop(self.name)

    def reset(self) -> Procedure[None]:
        """Open a lost link, set up a drive that has restarted, acknowledge a fault."""
        self._goal_on, self._homing = False, None
        link = self._link
        with raised_as_axis_error(self.name):
            link.open()
            if self._opening != link.openings:
                yield from self._protocol.identify()
                yield from self._refresh()
            shows_restart = self._protocol.capabilities.identity
            if self._at.rebooted or (self._opening != link.openings and not shows_restart):
                self._homed = False
                yield from self._set_up()
            else:
                self._opening = link.openings
                yield from self._protocol.clear_fault(self.name)
            self._begin()
            yield from self._refresh()
            if self._at.fault:
                raise DriveError(f"the drive {self._at.fault}")

    def close(self) -> Procedure[None]:
        """Stop, switch off and release the drive."""
        if not self._configured:
            return
        self._homing, self._configured = None, False
        with raised_as_axis_error(self.name):
            self._protocol.stop(self.name)
            for _ in range(self._max_stop):
                yield from self._refresh()
                if not self._at.moving:
                    break
                yield Wait(lambda: bool(self._link.lost), PERIOD)
            yield from self._protocol.release(self.name)

    # ---- feedback -----------------------------------------------------------------------------

    def poll(self, now: float) -> AxisSnapshot:
        """Return the newest feedback."""
        at = self._at
        return self._snapshot(
            at.position,
            self._target,
            time=self._time,
            powered=(at.powered and self._goal_on) or self._released,
            homed=self._homed and not at.rebooted,
            at_home_switch=at.home_switch,
            at_inner_switch=at.inner_switch,
            ready=self._ready,
            answered=self.answered,
            released_after_block=self._released,
            stop_failure=self._stop_failure,
        )

    @property
    def needs_cycles(self) -> bool:
        """Whether the drive still executes an order other than a set-point."""
        if self._fault is not None:
            return False
        switching = self._goal_on is not self._at.powered and not self._released
        return switching or self._homing is not None or self._limits_due

    def transmit(self) -> Procedure[None]:
        """Send this cycle's order; raises `LinkError` if the link is lost."""
        if not self._configured:
            return
        if self._limits_due and not self._at.powered and self._homed:
            yield from self._write_limits()
        wants_power = self._goal_on and not self._released and self._fault is None
        at_rest = self._still >= _REST or self._order_cycles > self._max_stop
        if wants_power is not self._at.powered and (wants_power or at_rest):
            self._protocol.power(self.name, wants_power)
        if self._homing is not None and self._ready_for_orders:
            self._advance_homing()
        if self._set_point_speed is not None:
            self._protocol.move_to(self.name, self._target, self._set_point_speed)
            self._set_point_speed = None

    def update(self, at: DriveReply, time: float) -> None:
        """Handle the drive's state, which was requested at steady time `time` [s]."""
        before, self._at = self._at, at
        periods = max(1, round((time - self._time) / PERIOD)) if self._time > 0.0 else 1
        self._time = time
        moved = self._settings.position(at.position - before.position)
        self._velocity = moved / (periods * PERIOD)
        self._cycles += 1
        self._order_cycles += 1
        still = not at.moving and abs(moved) <= self._settings.tolerance
        self._still = self._still + 1 if still else 0
        if not self._configured:
            self._target = at.position
            return
        if self._homing is not None:
            self._speed.command(self._homing_speed)
            self._travelled += abs(moved)
        self._speed.check(moved, periods, powered=at.powered)
        self._check_stop(at)
        self._check_power(at)
        if not (self._was_ready and self._ready_for_orders):
            # A drive that switches on or stops must start where the axis stands.
            self._target = at.position
        self._was_ready = self._ready_for_orders

    # ---- parts --------------------------------------------------------------------------------

    @property
    def _ready_for_orders(self) -> bool:
        return self._goal_on and self._at.powered and not (self._stopping or self._released)

    @property
    def _ready(self) -> bool:
        return self._ready_for_orders and self._homing is None

    @property
    def _fault(self) -> Problem | None:
        at = self._at
        for rule, text in (
            (Rule.LINK_LOSS, self._link.lost),
            (Rule.DRIVE_REBOOT, "the drive restarted; its home is lost" if at.rebooted else ""),
            (Rule.DRIVE_WATCHDOG, "the drive's watchdog stopped it" if at.timed_out else ""),
            (Rule.ONE_MASTER, _CONFLICT if at.conflict else ""),
            (Rule.DRIVE_EMERGENCY, f"the drive {at.fault}" if at.fault else ""),
            (Rule.AXIS_SPEED, self._speed.problem),
        ):
            if text:
                return Problem(rule, text)
        return self._problem

    def _move_to(self, target: int, speed: float) -> None:
        self._target = target
        self._set_point_speed = self._settings.magnitude(speed)
        self._speed.command(speed)
        self._order_cycles = 0

    def _begin(self) -> None:
        """Start over after a set-up or reset, with the drive off."""
        self._problem = None
        self._stopping = self._released = self._was_off = False
        self._cycles = self._order_cycles = 0
        self._restart_feedback()

    def _set_up(self) -> Procedure[None]:
        yield from self._protocol.set_up(self.name)
        self._opening = self._link.openings
        self._limits_due = False
        self._begin()
        yield from self._refresh()

    def _write_limits(self) -> Procedure[None]:
        lower, upper = (count + self._zero for count in self._settings.limits_counts)
        try:
            yield from self._protocol.write_limits(self.name, lower, upper)
        except DriveError as error:
            self._problem = Problem(Rule.ONE_FAULT_STOPS_BOTH, str(error))
            return
        self._limits_due = False

    def _advance_homing(self) -> None:
        settings, at = self._settings, self._at
        if settings.homing_method in PRESENT_POSITION_METHODS:
            self._count_from_home(at.position)
            return
        if self._homing is _Homing.SEARCH and at.home_switch:
            self._homing = _Homing.SETTLE
        elif self._homing is _Homing.SETTLE and self._still >= _REST:
            self._homing, self._target = _Homing.LEAVE, at.position
        elif self._homing is _Homing.LEAVE and not at.home_switch:
            self._count_from_home(at.position)
        elif self._travelled > settings.longest_search:
            self._problem = Problem(
                Rule.HOMING_TIME,
                f"moved {settings.text(self._travelled)} without finding home, limit "
                f"{settings.text(settings.longest_search)}",
            )
        elif self._homing is not _Homing.SETTLE:
            search = self._homing is _Homing.SEARCH
            speed = self._homing_speed * (1.0 if search else _EDGE_SPEED)
            step = settings.magnitude(speed * PERIOD) * settings.direction
            self._move_to(self._target + (-step if search else step), speed)

    def _check_stop(self, at: DriveReply) -> None:
        if self._stopping and self._still >= _REST:
            self._stopping = False
            gap = abs(self._settings.position(self._last_target - at.position))
            # The drive would move a blocked axis as soon as it is freed.
            self._released = self._goal_on and gap > _BLOCKED * self._settings.speed * PERIOD
        ends = self._stopping or not self._goal_on
        if ends and at.powered and at.moving and self._order_cycles > self._max_stop:
            self._protocol.power(self.name, False)
            self._set_problem(
                Rule.QUICK_STOP, "the drive keeps moving after a stop and is switched off"
            )

    def _check_power(self, at: DriveReply) -> None:
        off = not self._goal_on or self._released
        if self._goal_on and not at.powered and not off and self._cycles > _MAX_SWITCHING:
            self._set_problem(
                Rule.ONE_FAULT_STOPS_BOTH,
                f"the drive is not on after {_MAX_SWITCHING * PERIOD:g} s",
            )
        if self._was_off and off and at.powered:
            self._set_problem(Rule.ONE_MASTER, "another program has switched the drive on")
        self._was_off = off and not at.powered
        idle = self._ready and self._order_cycles > self._max_stop
        drift = abs(self._settings.position(at.position - self._target))
        if idle and (at.moving or drift > self._settings.following_error):
            self._set_problem(
                Rule.ONE_MASTER,
                f"moves without an order, {self._settings.text(drift)} from its set-point",
            )

    def _set_problem(self, rule: Rule, text: str) -> None:
        self._problem = self._problem or Problem(rule, text)

    @property
    def _stop_failure(self) -> str:
        if self._goal_on or self._cycles <= self._max_stop + _REST:
            return ""
        failures = ["powered"] * self._at.powered + ["moving"] * self._at.moving
        return f"still {' and '.join(failures)}" if failures else ""
