"""Inputs of a `LiveNeedle`; implausible messages are rejected."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np

from needle_bags.live.live_needle import LiveNeedle, MeasuredTip, TipEstimate
from needle_controller.model.target_plane import RIG, plane_from_pose
from needle_core import messages as m
from needle_core.component import (
    JOINT_STATES,
    LATCHED,
    Actions,
    Diagnose,
    Input,
    Log,
    Moment,
    Output,
    Publish,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.rotations import received_rotation
from needle_core.status_messages import ControllerStatus
from needle_tracker.answers.tracker_messages import insertion_of

# Larger positions [m] and variances [m^2] are implausible.
_MAX_PLAUSIBLE = 10.0
PROPOSALS = Output("needle/proposed_target", m.Point)
"""Target points of planners; the controller waits until a person accepts one."""


def needle_inputs(needle: LiveNeedle) -> tuple[Input, ...]:
    """Return the inputs that update a `LiveNeedle`."""
    rows = (
        Input("needle/tip_pose", m.PoseWithCovariance, partial(_on_tip, needle)),
        Input("joint_states", m.JointState, partial(_on_joints, needle), JOINT_STATES),
        Input("needle/estimate", m.PoseWithCovariance, partial(_on_estimate, needle)),
        Input(
            "needle/controller_status", ControllerStatus, partial(_on_controller, needle), LATCHED
        ),
        Input("target_plane", m.Pose, partial(_on_plane, needle), LATCHED),
    )
    return tuple(map(rejecting, rows))


def proposed_target(position: m.Vector3, stamp_ns: int) -> Publish:
    """Propose a target point in `rig` [m]; raise a `UserError` if it is implausible."""
    if not _is_plausible(position):
        raise UserError(f"no target is at {position} m")
    return Publish(PROPOSALS.topic, m.Point(stamp_ns, RIG, position))


def rejecting(row: Input) -> Input:
    """Return an input that turns a handler's UserError into a warning in /diagnostics."""

    def handle(message: Any, at: Moment) -> Actions:
        health = Diagnostic(Level.OK, "ok")
        try:
            yield from row.handler(message, at)
        except UserError as error:
            health = Diagnostic(Level.WARN, f"refused: {error}")
            yield Log("warning", f"{row.topic}: {health.message}", row.topic)
        yield Diagnose(row.topic, health)

    return dataclasses.replace(row, handler=handle)


def _on_joints(needle: LiveNeedle, message: m.JointState, at: Moment) -> Actions:
    insertion = insertion_of(message)
    if insertion is None or not _is_plausible(insertion):
        raise UserError(f"no needle has its insertion_joint at {insertion} m")
    needle.set_insertion(insertion)
    needle.joints = message
    return ()


def _on_tip(needle: LiveNeedle, message: m.PoseWithCovariance, at: Moment) -> Actions:
    position, rotation, covariance = _parts(message)
    if rotation is not None and _is_plausible(position, covariance):
        quaternion = np.array(message.orientation)
        needle.add_tip(MeasuredTip(message.stamp_ns, position, quaternion, covariance))
    else:
        # An infinite covariance means that no tip was found.
        needle.add_missing_tip(message.stamp_ns)
    return ()


def _on_estimate(needle: LiveNeedle, message: m.PoseWithCovariance, at: Moment) -> Actions:
    position, rotation, covariance = _parts(message)
    if rotation is None or not _is_plausible(position, covariance):
        raise UserError("no needle can be there, or it has no orientation")
    needle.set_estimate(TipEstimate(position, rotation, covariance, message.stamp_ns))
    return ()


def _on_controller(needle: LiveNeedle, message: ControllerStatus, at: Moment) -> Actions:
    offset, point = message.target_offset_m, message.target_point_m
    if not _is_plausible(offset or 0.0, point or 0.0):
        raise UserError(f"no plane is {offset} m off, or no point at {point} m")
    needle.set_targets(offset, None if point is None else np.array(point))
    return ()


def _on_plane(needle: LiveNeedle, message: m.Pose, at: Moment) -> Actions:
    needle.request_plane(plane_from_pose(message.frame_id, message.position, message.orientation))
    return ()


def _is_plausible(*parts: Any) -> bool:
    """Return whether all numbers are finite and within the plausible range."""
    return all(bool(np.all(np.abs(part) <= _MAX_PLAUSIBLE)) for part in parts)


def _parts(pose: m.PoseWithCovariance) -> tuple[Any, Any, Any]:
    """Return position, rotation (None without orientation) and covariance of the position."""
    covariance = np.array(pose.covariance).reshape(6, 6)[:3, :3]
    return np.array(pose.position), received_rotation(pose.orientation), covariance
