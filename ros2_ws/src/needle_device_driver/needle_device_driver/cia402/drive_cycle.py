"""CiA 402 drives on a CAN bus: cycle of commands, set-points, SYNC and answers; health."""

from __future__ import annotations

from collections.abc import Sequence

from needle_core.can_frame import CAN, CanErrors, CanFrame
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.cycle_times import PERIOD
from needle_device_driver.axes.drives import Drives
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.objects import SYNC
from needle_device_driver.procedure import Procedure

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
    watchdog : float
        A drive stops after this time without the computer's heartbeat [s].
    """

    def __init__(self, link: FrameLink, axes: Sequence[Cia402Axis], watchdog: float) -> None:
        super().__init__(CAN, link, {axis.name: axis for axis in axes})
        self.capabilities = Capabilities(
            streams=True,
            watchdog=watchdog,
            longest_order=PERIOD,
            response_time=PERIOD,
            encoder=True,
            switches=True,
            limits=True,
            identity=True,
            exclusive=True,
        )
        self._link = link
        self._axes = tuple(axes)
        self._outstanding = 0
        self._paused = 0

    @property
    def missing_optional_parts(self) -> tuple[str, ...]:
        """Optional objects that the drives lack."""
        return tuple(
            f"{axis.name} drive {text}"
            for axis in self._axes
            for text in axis.missing_optional_objects
        )

    def receive(self, batch: Sequence[CanFrame | CanErrors]) -> None:
        """Receive frames and error counts from the port."""
        self._link.receive(batch)

    def are_emulated(self) -> Procedure[bool]:
        """Return whether each drive reports that it is emulated; raises `LinkError`."""
        return are_emulated(self._link, [axis.node_id for axis in self._axes])

    def _identify(self) -> Procedure[None]:
        for axis in self._axes:
            yield from axis.probe()

    def beat(self) -> None:
        """Send the computer's heartbeat if the link is open."""
        if self._link.is_open:
            self._link.beat()

    def collect(self) -> None:
        """Process answers that arrived after the end of the last cycle."""
        for axis in self._axes:
            axis.update()

    def _request(self, timeout: float) -> float:
        if self._must_pause():
            return min(timeout, _PAUSE_WAIT)
        for axis in self._axes:
            axis.monitor.expect_answer()
        self._link.send(SYNC)
        return timeout

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
