"""Cycle of all drives on a bus: commands and set-points, SYNC, answers; and its health."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core.diagnostics import Diagnostic, Level
from needle_device_driver.axes.axis import AxisError
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.link.objects import SYNC
from needle_device_driver.procedure import Procedure, Wait

# A pause for late answers: its length in cycles, and the wait in each of them [s].
_PAUSE = 2
_PAUSE_WAIT = 0.015
# A cycle is late if it begins later by this share of a period.
_LATE = 0.5


class CycleTimes:
    """Measures whether cycles begin on time.

    Parameters
    ----------
    period : float
        Between cycles [s].
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._begun: float | None = None
        self._longest = 0.0
        self._late = 0

    def begin(self, now: float) -> None:
        """Note that a cycle begins at steady time `now` [s]."""
        if self._begun is not None:
            between = now - self._begun
            self._longest = max(self._longest, between)
            self._late += between > (1.0 + _LATE) * self._period
        self._begun = now

    def take(self) -> dict[str, str]:
        """Return the number of late cycles, and the longest cycle since the last call."""
        longest, self._longest = self._longest, 0.0
        return {"late_cycles": str(self._late), "longest_cycle_s": f"{longest:.4f}"}


class DriveCycle:
    """Sends the frames of each cycle and receives the answers.

    Parameters
    ----------
    link : FrameLink
        The bus.
    axes : sequence of Cia402Axis
        The axes of all its drives.
    period : float
        Of the cycle [s].

    Attributes
    ----------
    times : CycleTimes
        Whether the cycles begin on time.
    unanswered : int
        Number of SYNCs that a drive did not answer in their cycle.
    """

    def __init__(self, link: FrameLink, axes: Sequence[Cia402Axis], period: float) -> None:
        self._link = link
        self._axes = tuple(axes)
        self.times = CycleTimes(period)
        self.unanswered = 0
        self._outstanding = 0
        self._paused = 0
        self._reported_unanswered = 0

    @property
    def missing_optional_objects(self) -> tuple[str, ...]:
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
            **self.times.take(),
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
