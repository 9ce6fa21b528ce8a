"""CiA 402 drives on a CAN bus: cycle of commands, set-points, SYNC and answers; health."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core.can_frame import CAN, CanErrors, CanFrame
from needle_core.diagnostics import Diagnostic, Level
from needle_device_driver.axes.axis import AxisError
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.drive_errors import LinkError
from needle_device_driver.axes.drives import Drives
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import SYNC
from needle_device_driver.procedure import Procedure, Wait

# A pause for late answers: its length in cycles, and the wait in each of them [s].
_PAUSE = 2
_PAUSE_WAIT = 0.015


class Cia402Drives(Drives):
    """CiA 402 drives on one bus.

    Parameters
    ----------
    link : FrameLink
        The bus.
    axes : sequence of Cia402Axis
        The axes of all its drives.
    period : float
        Of the cycle [s].
    watchdog : float
        A drive stops after this time without the computer's heartbeat [s].

    Attributes
    ----------
    unanswered : int
        Number of SYNCs that a drive did not answer in their cycle.
    """

    port = CAN

    def __init__(
        self, link: FrameLink, axes: Sequence[Cia402Axis], period: float, watchdog: float
    ) -> None:
        self.name = link.name
        self.capabilities = Capabilities(
            streams=True,
            watchdog=watchdog,
            longest_order=period,
            response_time=period,
            encoder=True,
            switches=True,
            limits=True,
            identity=True,
            exclusive=True,
        )
        self.axes = {axis.name: axis for axis in axes}
        self._link = link
        self._axes = tuple(axes)
        self.unanswered = 0
        self._outstanding = 0
        self._paused = 0
        self._reported_unanswered = 0

    @property
    def missing_optional_parts(self) -> tuple[str, ...]:
        """Optional objects that the drives lack."""
        return tuple(
            f"{axis.name} drive {text}"
            for axis in self._axes
            for text in axis.missing_optional_objects
        )

    @property
    def needs_cycles(self) -> bool:
        """Whether a drive still executes an order other than a set-point."""
        return any(axis.needs_cycles for axis in self._axes)

    def health(self, waiting: str) -> Diagnostic:
        """Return the health of the bus since the last call; `waiting` describes a closed link."""
        link = self._link
        values = {
            "link": link.name,
            "frames_sent": str(link.frames_sent),
            "frames_received": str(link.frames_received),
            "bus_errors": str(link.error_frames),
            "unanswered_syncs": str(self.unanswered),
        }
        count = self.unanswered - self._reported_unanswered
        self._reported_unanswered = self.unanswered
        level, message = Level.OK, "connected"
        if link.lost:
            level, message = Level.ERROR, link.lost
        elif not link.is_open:
            level, message = Level.WARN, waiting
        elif count:
            level, message = Level.WARN, f"{count} SYNCs had no reply within their cycle"
        return Diagnostic(level, message, values)

    @property
    def now(self) -> float:
        """Steady time of the running handler [s]."""
        return self._link.now

    @now.setter
    def now(self, value: float) -> None:
        self._link.now = value

    def receive(self, batch: Sequence[CanFrame | CanErrors]) -> None:
        """Receive frames and error counts from the port."""
        self._link.receive(batch)

    def set_port_error(self, error: str) -> None:
        """Note why the port is not open; empty: it is open."""
        self._link.set_port_error(error)

    def pop_outgoing(self) -> tuple[CanFrame, ...]:
        """Return the frames that were sent since the last call."""
        return self._link.pop_outgoing()

    def are_emulated(self) -> Procedure[bool]:
        """Return whether each drive reports that it is emulated; raises `LinkError`."""
        return are_emulated(self._link, [axis.node_id for axis in self._axes])

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def probe(self) -> Procedure[str]:
        """Open the link and request an answer of every drive; return the error."""
        try:
            self._link.open()
            for axis in self._axes:
                yield from axis.probe()
        except (AxisError, LinkError) as error:
            return str(error)
        return ""

    def beat(self) -> None:
        """Send the computer's heartbeat if the link is open."""
        if self._link.is_open:
            self._link.beat()

    def collect(self) -> None:
        """Process answers that arrived after the end of the last cycle."""
        for axis in self._axes:
            axis.update()

    def exchange(self, timeout: float) -> Procedure[None]:
        """Run one cycle; wait at most `timeout` [s] for the answers."""
        if not self._link.is_open:
            return
        try:
            self._link.beat()
            for axis in self._axes:
                yield from axis.transmit()
            if self._must_pause():
                timeout = min(timeout, _PAUSE_WAIT)
            else:
                for axis in self._axes:
                    axis.monitor.expect_answer()
                self._link.send(SYNC)
        except LinkError:
            # The axes report the loss.
            return
        yield Wait(lambda: bool(self._link.lost) or self._answered(), timeout)
        self.unanswered += not self._answered()
        self.collect()

    def _must_pause(self) -> bool:
        """Return whether answers are so late that another SYNC would mix them up.

        Answers that are missing at the end of the pause count as lost.
        """
        before = self._outstanding
        self._outstanding = sum(axis.monitor.outstanding for axis in self._axes)
        if self._outstanding < before:
            self._paused = 0
        if not self._outstanding:
            return False
        self._paused += 1
        if self._paused <= _PAUSE:
            return True
        for axis in self._axes:
            axis.monitor.discard_outstanding()
        return False

    def _answered(self) -> bool:
        return all(axis.monitor.answered() for axis in self._axes)
