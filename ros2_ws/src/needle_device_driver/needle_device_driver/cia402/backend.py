"""CiA 402 drives on a CAN bus as a backend: cycle of commands, set-points, SYNC and answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from needle_core.can_frame import CAN, CanErrors, CanFrame
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.axis import PERIOD
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.backend import Backend
from needle_device_driver.axes.capabilities import Capabilities
from needle_device_driver.axes.drives import Drives
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.cia402.drive_upkeep import are_emulated
from needle_device_driver.link.can_port import CanPort, LinkSettings
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
        Time without the computer's heartbeat after which a drive stops [s].
    """

    def __init__(self, link: FrameLink, axes: Sequence[Cia402Axis], watchdog: float) -> None:
        super().__init__(CAN, link, {axis.name: axis for axis in axes})
        self.capabilities = Capabilities(
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


def _of_axis(axis: str, node_id: int) -> list[tuple[str, type, Any]]:
    fields = {
        "node_id": fixed_parameter(node_id, "-", "CANopen node id of the drive.", 1, 126),
        "counts_per_turn": fixed_parameter(
            0.0, "counts", "Counts per turn of a drive in rpm; 0: as it reports (0x608F).", 0.0, 1e9
        ),
        "following_error_time": fixed_parameter(
            0.05, "s", "Time for which the drive tolerates a larger following error.", 0.001, 10.0
        ),
        "max_torque": fixed_parameter(
            0.0, "-", "Maximum share of the rated torque; 0: the drive's setting.", 0.0, 5.0
        ),
    }
    return [(f"{axis}_{name}", type(f.default), f) for name, f in fields.items()]


Cia402Parameters = dataclasses.make_dataclass(
    "Cia402Parameters",
    [*_of_axis("insertion", 1), *_of_axis("rotation", 2)],
    bases=(LinkSettings,),
    frozen=True,
)
Cia402Parameters.__doc__ = "Parameters of the CAN adapter and of both drives on the bus."
_OWN = ("node_id", "counts_per_turn", "following_error_time", "max_torque")


def drive_settings(parameters: Any, axis: str) -> DriveSettings:
    """Return the settings of an axis' drive from the parameters of device_driver."""
    own = {key: getattr(parameters, f"{axis}_{key}") for key in _OWN}
    return DriveSettings(**vars(parameters.axis(axis)), **own)


def _make(parameters: Any, axes: Mapping[str, AxisSettings]) -> Cia402Drives:
    link, watchdog = FrameLink(parameters.link_name), parameters.watchdog
    made = [Cia402Axis(name, drive_settings(parameters, name), link, watchdog) for name in axes]
    return Cia402Drives(link, made, watchdog)


def _check(parameters: Any) -> None:
    LinkSettings.__post_init__(parameters)
    for name in parameters.axes_of(BACKEND):
        drive_settings(parameters, name)
    if len(parameters.axes_of(BACKEND)) == 2 and (
        parameters.insertion_node_id == parameters.rotation_node_id
    ):
        raise UserError("insertion_node_id and rotation_node_id are the same")


BACKEND = Backend(
    port=CAN,
    settings=Cia402Parameters,
    make=_make,
    open_port=lambda parameters: CanPort(parameters, parameters.write_timeout),
    check=_check,
)
"""The entry points `cia402` and `hand`."""
