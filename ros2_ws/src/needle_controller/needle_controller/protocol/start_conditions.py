"""Conditions under which steering may start."""

from __future__ import annotations

from needle_controller.presets.own_parts import OwnPartError
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.actions import DEPTH_TOLERANCE
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.status_messages import DeviceStatus

_SAME_INSERTION, _SAME_ROTATION = 5e-5, 2e-2


def is_out(joints: JointSample, settings: SteeringSettings) -> bool:
    """Return whether the needle counts as out of the tissue."""
    return joints.insertion <= settings.needle_out_insertion


def reason_not_to_start(
    device: DeviceStatus | None,
    joints: JointSample | None,
    withdrawal: str,
    control: PlaneControl,
    settings: SteeringSettings,
) -> str:
    """Return why steering cannot start; empty if it can.

    Parameters
    ----------
    device : DeviceStatus or None
        Last status of the driver.
    joints : JointSample or None
        Present joint positions.
    withdrawal : str
        Why the needle must be withdrawn first; empty if it need not be.
    control : PlaneControl
        Estimator and law, for the roll at the entry and the path around obstacles.
    settings : SteeringSettings
        Settings of the protocol.
    """
    if device is None:
        return "no device/status received"
    reason = _device_reason(device)
    if reason:
        return reason
    if joints is None:
        return "no joint_states received"
    if not _agree(device, joints):
        return (
            f"waiting for joint_states to agree with device/status ({joints.insertion:.4g} m, "
            f"{joints.rotation:.4g} rad; the device {device.insertion_m:.4g} m, "
            f"{device.rotation_rad:.4g} rad)"
        )
    return withdrawal or _needle_reason(joints, control, settings)


def _device_reason(device: DeviceStatus) -> str:
    if device.state == "MOVING":
        return "waiting for the device to stop"
    if not device.homed:
        return "the device is not homed"
    if device.state != "HOLDING":
        return f"the device is not enabled ({device.state})"
    return ""


def _agree(device: DeviceStatus, joints: JointSample) -> bool:
    """Return whether the joints are those of the device's status, not of an earlier motion."""
    if device.insertion_m is None or device.rotation_rad is None:
        return True
    reported = JointSample(joints.stamp_ns, device.insertion_m, device.rotation_rad)
    return joints.is_near(reported, _SAME_INSERTION, _SAME_ROTATION)


def _needle_reason(joints: JointSample, control: PlaneControl, settings: SteeringSettings) -> str:
    if joints.insertion >= settings.depth - DEPTH_TOLERANCE:
        return f"insertion {joints.insertion:g} m has reached the depth {settings.depth:g} m"
    if not is_out(joints, settings):
        if control.started:
            return ""
        return (
            f"the needle is {joints.insertion:g} m in, on an unknown path: "
            f"withdraw it first (<= {settings.needle_out_insertion:g} m)"
        )
    try:
        return control.roll_problem(joints.rotation) or control.path_problem(joints.rotation)
    except OwnPartError as error:
        return str(error)
