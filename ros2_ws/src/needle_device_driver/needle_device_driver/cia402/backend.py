"""CiA 402 drives as a backend of device_driver, and its parameters."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from needle_core.can_frame import CAN
from needle_core.errors import UserError
from needle_core.settings.parameter_fields import fixed_parameter
from needle_device_driver.axes.axis_settings import AxisSettings
from needle_device_driver.axes.backend import Backend
from needle_device_driver.cia402.cia402_axis import Cia402Axis
from needle_device_driver.cia402.drive_cycle import Cia402Drives
from needle_device_driver.cia402.drive_settings import DriveSettings
from needle_device_driver.link.can_port import CanPort
from needle_device_driver.link.frame_link import FrameLink
from needle_device_driver.link.link_settings import LinkSettings


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
