"""Interface of device_driver to the drives behind one port."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from typing import Any

from needle_core.diagnostics import Diagnostic, Level
from needle_device_driver.axes.axis import PERIOD, Axis, AxisError, AxisSnapshot
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.link import DriveError, Link, LinkError, raised_as_axis_error
from needle_device_driver.axes.speed_monitor import SpeedMonitor
from needle_device_driver.procedure import Procedure, Wait
from needle_device_driver.rules import Problem, Rule


class CyclicAxis(Axis):
    """Axis of a drive that receives its orders once per cycle.

    Orders return at once, and `transmit` sends them in the next cycle; only a stop is sent
    immediately. The drive stops at the last set-point if no new one arrives.

    Parameters
    ----------
    name : str
        Insertion or rotation.
    settings : AxisSettings
        Settings of the axis.
    link : Link
        Connection to the drive.

    Attributes
    ----------
    name : str
        Insertion or rotation.
    """

    # Bounds of the set-points of an axis that is not homed [counts].
    _counter = (-math.inf, math.inf)

    def __init__(self, name: str, settings: AxisSettings, link: Link) -> None:
        self.name = name
        self.actuated = settings.actuated
        self._settings, self._link = settings, link
        self._speed = SpeedMonitor(settings, PERIOD)
        self._configured = self._homed = self._limits_due = False
        self._opening = self._origin = self._zero = 0
        self._velocity = 0.0
        self._homing: Any = None

    @abc.abstractmethod
    def transmit(self) -> Procedure[None]:
        """Send this cycle's order; raises `LinkError` if the link is lost."""

    def configure(self) -> Procedure[None]:
        """Set the drive up; moves nothing."""
        with raised_as_axis_error(self.name):
            yield from self._set_up()
        self._configured = True

    @property
    @abc.abstractmethod
    def _fault(self) -> Problem | None:
        """Reason why the axis refuses to move; None: it does not."""

    @abc.abstractmethod
    def _set_up(self) -> Procedure[None]:
        """Set the drive up."""

    def _refuse_fault(self) -> None:
        if not self._configured:
            raise AxisError(f"{self.name} axis is not configured")
        if (fault := self._fault) is not None:
            raise AxisError(f"{self.name} axis: {fault.text}", fault.rule)

    def _refuse_power(self) -> None:
        self._refuse_fault()
        if self._limits_due:
            raise AxisError(f"{self.name} axis has no software limits yet")

    def _check_move(self, target: float, speed: float, last: int) -> int:
        """Check a set-point against fault, limits and largest step; return it in counts."""
        self._refuse_fault()
        settings, counts = self._settings, self._settings.counts(target)
        lower, upper = settings.limits_counts if self._homed else self._counter
        if not lower <= counts <= upper:
            # When its counter overflows, a drive may continue, stop, or travel all the way back.
            raise AxisError(
                f"{self.name} axis: target {target:.6g} is outside the drive's "
                f"{settings.limits if self._homed else 'counter; home it, or set it nearer 0'}",
                Rule.SOFTWARE_LIMITS,
            )
        step = abs(counts + self._zero - last)
        bound = settings.magnitude(settings.speed * PERIOD * 1.01) + 1
        if step > bound:
            raise AxisError(
                f"{self.name} axis: set-point step of {step / settings.counts_per_unit:.6g} in a "
                f"cycle at {speed:.6g}/s, limit {bound / settings.counts_per_unit:.6g}",
                Rule.LOOK_AHEAD,
            )
        return counts + self._zero

    def _count_from_home(self, zero: int = 0) -> None:
        """Complete a homing: positions, and later the limits, count from `zero` [counts]."""
        self._homing, self._homed, self._zero = None, True, zero
        # The limits can only be written while the drive is off.
        self._limits_due = self.actuated
        self._origin += 1

    def _restart_feedback(self) -> None:
        """Discard the motion before a set-up or reset, which may shift the zero of positions."""
        self._origin += 1
        self._speed.reset()
        self._velocity = 0.0

    def _snapshot(self, position: int, set_point: int, **state: Any) -> AxisSnapshot:
        """Return the feedback with both positions [counts]; `state` holds the other fields."""
        rule, fault = self._fault or (Rule.ONE_FAULT_STOPS_BOTH, "")
        return AxisSnapshot(
            position=self._settings.position(position - self._zero),
            set_point=self._settings.position(set_point - self._zero),
            velocity=self._velocity,
            moving=self._homing is not None,
            fault=fault,
            fault_rule=rule,
            origin=self._origin,
            **state,
        )


class Drives(abc.ABC):
    """The drives of one kind, with a common connection and cycle.

    Each cycle is `collect`, then orders to the axes, then `exchange`.

    Parameters
    ----------
    port : str
        Name of the component's port.
    link : Link
        The connection.
    axes : mapping of str to CyclicAxis
        Insertion, rotation or both, by name.

    Attributes
    ----------
    capabilities : Capabilities
        Abilities of the drives.
    unanswered : int
        Number of cycles in which not every drive answered.
    """

    capabilities: Capabilities

    def __init__(self, port: str, link: Link, axes: Mapping[str, CyclicAxis]) -> None:
        self.port, self.link, self.axes = port, link, axes
        self.unanswered = self._reported_unanswered = 0

    @property
    def missing_optional_parts(self) -> tuple[str, ...]:
        """Optional parts that the drives lack and that a safety rule would use."""
        return ()

    @abc.abstractmethod
    def receive(self, batch: Sequence[Any]) -> None:
        """Receive a batch from the port."""

    def probe(self) -> Procedure[str]:
        """Open the link and check that every drive answers; return the error, if any."""
        try:
            self.link.open()
            yield from self._identify()
        except (AxisError, DriveError, LinkError) as error:
            return str(error)
        return ""

    @abc.abstractmethod
    def are_emulated(self) -> Procedure[bool]:
        """Return whether each drive reports that it is emulated; otherwise it counts as real.

        Raises
        ------
        LinkError
            If the link is lost.
        """

    @abc.abstractmethod
    def beat(self) -> None:
        """Report to the drives' watchdogs that the control loop runs, if the link is open."""

    def collect(self) -> None:
        """Process answers that arrived after the end of the last cycle."""
        return

    def exchange(self, timeout: float) -> Procedure[None]:
        """Run one cycle; wait at most `timeout` [s] for the answers."""
        if not self.link.is_open:
            return
        try:
            self.beat()
            for axis in self.axes.values():
                yield from axis.transmit()
            timeout = self._request(timeout)
        except LinkError:
            # The axes report the loss.
            return
        yield Wait(lambda: bool(self.link.lost) or self._answered(), timeout)
        self.unanswered += not self._answered()
        self.collect()

    @abc.abstractmethod
    def _identify(self) -> Procedure[None]:
        """Check that every drive answers."""

    @abc.abstractmethod
    def _request(self, timeout: float) -> float:
        """Request the feedback of all drives; return how long to wait for it [s]."""

    @abc.abstractmethod
    def _answered(self) -> bool:
        """Return whether all drives have answered."""

    def health(self, waiting: str) -> Diagnostic:
        """Return the health of the link since the last call; `waiting` describes a closed link."""
        link = self.link
        values = {"link": link.name, **link.counts, "unanswered_cycles": str(self.unanswered)}
        count = self.unanswered - self._reported_unanswered
        self._reported_unanswered = self.unanswered
        level, message = Level.OK, "connected"
        if link.lost:
            level, message = Level.ERROR, link.lost
        elif not link.is_open:
            level, message = Level.WARN, waiting
        elif count:
            level, message = Level.WARN, f"{count} cycles had no answer in time"
        return Diagnostic(level, message, values)
