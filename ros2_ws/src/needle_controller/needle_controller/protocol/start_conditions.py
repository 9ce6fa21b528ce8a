"""Conditions under which steering begins."""

from __future__ import annotations

import dataclasses

from needle_controller.presets.own_parts import OwnPartError
from needle_controller.presets.steering_settings import SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.next_step import DEPTH_TOLERANCE
from needle_controller.protocol.plane_control import PlaneControl
from needle_core.status_messages import DeviceStatus

_SAME_INSERTION, _SAME_ROTATION = 5e-5, 2e-2


@dataclasses.dataclass(frozen=True)
class Situation:
    """State of the rig when somebody asks to start.

    Attributes
    ----------
    steering : bool
        Whether it is steering already.
    device : DeviceStatus or None
        What the driver last said.
    joints : JointSample or None
        Where the joints are.
    withdrawal : str
        Why the needle must be drawn out first; empty if it need not be.
    """

    steering: bool
    device: DeviceStatus | None
    joints: JointSample | None
    withdrawal: str


def is_out(joints: JointSample, settings: SteeringSettings) -> bool:
    """Return whether the needle counts as out."""
    return joints.insertion <= settings.needle_out_insertion


def obstacle(situation: Situation, control: PlaneControl, settings: SteeringSettings) -> str:
    """Return why steering cannot begin, empty if it can.

    Parameters
    ----------
    situation : Situation
        What is known of the rig.
    control : PlaneControl
        Estimator and law, for how the needle would enter the target plane.
    settings : SteeringSettings
        The protocol's numbers.
    """
    device, joints = situation.device, situation.joints
    if situation.steering:
        return "already steering"
    why = _device_obstacle(device)
    if why or device is None:
        return why
    if joints is None:
        return "no joint_states have come"
    if not _agree(device, joints):
        return (
            f"waiting for joint_states to say what the device does ({joints.insertion:.4g} m, "
            f"{joints.rotation:.4g} rad; the device {device.insertion_m:.4g} m, "
            f"{device.rotation_rad:.4g} rad)"
        )
    return situation.withdrawal or _needle_obstacle(joints, control, settings)


def _device_obstacle(device: DeviceStatus | None) -> str:
    if device is None:
        return "no device/status has come"
    if device.state == "MOVING":
        return "waiting for the device, which moves"
    if not device.homed:
        return "the device is not homed"
    if device.state != "HOLDING":
        return f"the device is not enabled ({device.state})"
    return ""


def _agree(device: DeviceStatus, joints: JointSample) -> bool:
    """Return whether the joints are where the device has them: not those of a motion before."""
    if device.insertion_m is None or device.rotation_rad is None:
        return True
    there = JointSample(joints.stamp_ns, device.insertion_m, device.rotation_rad)
    return joints.is_at(there, _SAME_INSERTION, _SAME_ROTATION)


def _needle_obstacle(joints: JointSample, control: PlaneControl, settings: SteeringSettings) -> str:
    if joints.insertion >= settings.depth - DEPTH_TOLERANCE:
        return f"insertion {joints.insertion:g} m is at the depth {settings.depth:g} m"
    if not is_out(joints, settings):
        if control.started:
            return ""
        return (
            f"the needle is {joints.insertion:g} m in and was not followed there: "
            f"draw it out first (<= {settings.needle_out_insertion:g} m)"
        )
    roll = control.start_roll(joints.rotation)
    if abs(roll) > control.largest_start_roll:
        return (
            f"the needle's roll in target_plane is {roll:.3g} rad (rotation_joint "
            f"{joints.rotation:.4g} rad), wants within {control.largest_start_roll:.3g} rad"
        )
    try:
        return control.path_obstacle(joints.rotation)
    except OwnPartError as error:
        return str(error)
