"""Interface of device_driver to the drives behind one port."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from typing import Any

from needle_core.diagnostics import Diagnostic, Level
from needle_device_driver.axes.axis import Axis, AxisError
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.axes.drive_errors import DriveError, LinkError
from needle_device_driver.axes.link import Link
from needle_device_driver.procedure import Procedure, Wait
from needle_device_driver.rules import Rule

Fault = tuple[Rule, str]
"""Rule behind a fault, and its text."""


class CyclicAxis(Axis):
    """Axis whose orders other than set-points take several cycles.

    Attributes
    ----------
    name : str
        Insertion or rotation.
    """

    name: str
    _configured = False

    @property
    @abc.abstractmethod
    def needs_cycles(self) -> bool:
        """Whether the drive still executes an order other than a set-point."""

    @abc.abstractmethod
    def transmit(self) -> Procedure[None]:
        """Send this cycle's order; raises `LinkError` if the link is lost."""

    @property
    @abc.abstractmethod
    def _fault(self) -> Fault | None:
        """Reason why the axis refuses to move; None: it does not."""

    def _refuse_fault(self) -> None:
        if not self._configured:
            raise AxisError(f"{self.name} axis is not configured")
        if (fault := self._fault) is not None:
            raise AxisError(f"{self.name} axis: {fault[1]}", fault[0])

    def _check_step(self, settings: AxisSettings, step: int, speed: float) -> None:
        """Refuse a set-point that is farther from the last one than the greatest speed allows."""
        bound = settings.magnitude(settings.speed * PERIOD * 1.01) + 1
        if step > bound:
            raise AxisError(
                f"{self.name} axis: set-point step of {step / settings.counts_per_unit:.6g} in a "
                f"cycle at {speed:.6g}/s, limit {bound / settings.counts_per_unit:.6g}",
                Rule.LOOK_AHEAD,
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
    axes : sequence of Axis
        Insertion, rotation or both, by their names.

    Attributes
    ----------
    capabilities : Capabilities
        Abilities of the drives.
    unanswered : int
        Number of cycles without an answer of each drive.
    """

    capabilities: Capabilities

    def __init__(self, port: str, link: Link, axes: Mapping[str, CyclicAxis]) -> None:
        self.port, self.link, self.axes = port, link, axes
        self.unanswered = self._reported_unanswered = 0

    @property
    def missing_optional_parts(self) -> tuple[str, ...]:
        """Parts that the drives lack, although a rule profits from them."""
        return ()

    @property
    def needs_cycles(self) -> bool:
        """Whether a drive still executes an order other than a set-point."""
        return any(axis.needs_cycles for axis in self.axes.values())

    @abc.abstractmethod
    def receive(self, batch: Sequence[Any]) -> None:
        """Receive a batch from the port."""

    def probe(self) -> Procedure[str]:
        """Open the link and request an answer of every drive; return the error."""
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
        """Request an answer of every drive."""

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
