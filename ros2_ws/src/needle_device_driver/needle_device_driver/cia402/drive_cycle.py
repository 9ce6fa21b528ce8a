"""One cycle of all drives on a bus: commands and set-points, SYNC, answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from needle_core.diagnostics import Diagnostic, Level
from needle_device_driver.axes.axis import AxisError
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.link.frame_link import FrameLink, LinkError
from needle_device_driver.link.objects import SYNC
from needle_device_driver.procedure import Procedure, Wait

# How long a pause for answers that are late lasts, in cycles without any, and each of them [s].
_PAUSE = 2
_PAUSE_WAIT = 0.015


class DriveCycle:
    """Sends the cycle's frames and takes the answers.

    Parameters
    ----------
    link : FrameLink
        The bus.
    axes : sequence of Cia402Axis
        All its drives.

    Attributes
    ----------
    unanswered : int
        How many SYNCs a drive did not answer in their cycle.
    """

    def __init__(self, link: FrameLink, axes: Sequence[Cia402Axis]) -> None:
        self._link = link
        self._axes = tuple(axes)
        self.unanswered = 0
        self._outstanding = 0
        self._paused = 0
        self._told_unanswered = 0

    @property
    def missing_optional_objects(self) -> tuple[str, ...]:
        """Objects that the drives lack and could be set up without."""
        return tuple(
            f"{axis.name} drive {text}"
            for axis in self._axes
            for text in axis.missing_optional_objects
        )

    @property
    def needs_cycles(self) -> bool:
        """Tell whether a drive is on its way to where it was ordered, apart from set-points."""
        return any(axis.needs_cycles for axis in self._axes)

    def health(self, waiting: str, more: Mapping[str, str]) -> Diagnostic:
        """Return the health of the bus since the last call.

        Parameters
        ----------
        waiting : str
            What is said while the link is closed.
        more : mapping
            Further values.
        """
        link = self._link
        values = {
            "link": str(link.settings),
            "frames_sent": str(link.frames_sent),
            "frames_received": str(link.frames_received),
            "bus_errors": str(link.error_frames),
            **more,
            "unanswered_syncs": str(self.unanswered),
        }
        count, self._told_unanswered = self.unanswered - self._told_unanswered, self.unanswered
        level, message = Level.OK, "connected"
        if link.lost:
            level, message = Level.ERROR, link.lost
        elif not link.is_open:
            level, message = Level.WARN, waiting
        elif count:
            level, message = Level.WARN, f"{count} SYNCs were not answered in their cycle"
        return Diagnostic(level, message, values)

    def probe(self) -> Procedure[str]:
        """Open the link and ask every drive who it is; return why that is not possible."""
        try:
            self._link.open()
            for axis in self._axes:
                yield from axis.probe()
        except (AxisError, LinkError) as error:
            return str(error)
        return ""

    def beat(self) -> None:
        """Tell the drives' watchdogs that the loop runs."""
        if self._link.is_open:
            # The link remembers its loss, and the axes report it.
            try:
                self._link.beat()
            except LinkError:
                return

    def collect(self) -> None:
        """Take the answers that came too late for the cycle before."""
        for axis in self._axes:
            axis.update()

    def exchange(self, wait: float) -> Procedure[None]:
        """Run one cycle.

        Parameters
        ----------
        wait : float
            How long to wait for the drives' answers at most [s].
        """
        if not self._link.is_open:
            return
        try:
            self._link.beat()
            for axis in self._axes:
                yield from axis.transmit()
            if self._must_pause():
                wait = min(wait, _PAUSE_WAIT)
            else:
                for axis in self._axes:
                    axis.monitor.expect_answer()
                self._link.send(SYNC)
        except LinkError:
            return
        yield Wait(lambda: bool(self._link.lost) or self._answered(), wait)
        self.unanswered += not self._answered()
        for axis in self._axes:
            axis.update()

    def _must_pause(self) -> bool:
        """Return whether answers are so late that another SYNC would mix them up.

        What has not come by the end of the pause is taken for lost.
        """
        before, self._outstanding = (
            self._outstanding,
            sum(axis.monitor.outstanding for axis in self._axes),
        )
        if self._outstanding < before:
            self._paused = 0
        if not self._outstanding:
            return False
        self._paused += 1
        if self._paused <= _PAUSE:
            return True
        self._paused = self._outstanding = 0
        for axis in self._axes:
            axis.monitor.give_up()
        return False

    def _answered(self) -> bool:
        return all(axis.monitor.answered() for axis in self._axes)
