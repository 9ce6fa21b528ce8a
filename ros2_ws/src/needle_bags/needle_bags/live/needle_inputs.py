"""Inputs that tell of the needle: what cannot be of a needle is refused, never believed."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np

from needle_bags.live.live_needle import Belief, LiveNeedle, SeenTip
from needle_controller.model.target_plane import plane_from_pose
from needle_core import messages as m
from needle_core.component import (
    JOINT_STATES,
    LATCHED,
    Actions,
    Diagnose,
    Input,
    Log,
    Moment,
)
from needle_core.diagnostics import Diagnostic, Level
from needle_core.errors import UserError
from needle_core.status_messages import ControllerStatus
from needle_tracker.answers.tracker_messages import insertion_of, rotation_of

# Nothing of a rig is farther off, or less certain [m], [m^2]; what says so is not believed.
_FARTHEST = 10.0


def needle_inputs(needle: LiveNeedle) -> tuple[Input, ...]:
    """Return the rows of all that fills a `LiveNeedle`."""
    rows = (
        Input("needle/tip_pose", m.PoseWithCovariance, partial(_on_tip, needle)),
        Input("joint_states", m.JointState, partial(_on_joints, needle), JOINT_STATES),
        Input("needle/estimate", m.PoseWithCovariance, partial(_on_estimate, needle)),
        Input(
            "needle/controller_status", ControllerStatus, partial(_on_controller, needle), LATCHED
        ),
        Input("target_plane", m.Pose, partial(_on_plane, needle), LATCHED),
    )
    return tuple(map(refusing, rows))


def refusing(row: Input) -> Input:
    """Return an input whose handler refuses a message by UserError; its health is told by topic."""

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
    if insertion is None or not _is_near(insertion):
        raise UserError(f"no needle has its insertion_joint at {insertion} m")
    needle.take_insertion(insertion)
    return ()


def _on_tip(needle: LiveNeedle, message: m.PoseWithCovariance, at: Moment) -> Actions:
    place, rotation, covariance = _parts(message)
    if rotation is not None and _is_near(place, covariance):
        quaternion = np.array(message.orientation)
        needle.take_tip(SeenTip(message.stamp_ns, place, quaternion, covariance))
    else:
        # The tracker says so, too: an infinite covariance is no tip.
        needle.take_no_tip(message.stamp_ns)
    return ()


def _on_estimate(needle: LiveNeedle, message: m.PoseWithCovariance, at: Moment) -> Actions:
    place, rotation, covariance = _parts(message)
    if rotation is None or not _is_near(place, covariance):
        raise UserError("no needle can be there, or it has no orientation")
    needle.take_belief(Belief(place, rotation, covariance))
    return ()


def _on_controller(needle: LiveNeedle, message: ControllerStatus, at: Moment) -> Actions:
    offset, point = message.target_offset_m, message.target_point_m
    if not _is_near(offset or 0.0, point or 0.0):
        raise UserError(f"no plane is {offset} m off, or no point at {point} m")
    needle.take_targets(offset, None if point is None else np.array(point))
    return ()


def _on_plane(needle: LiveNeedle, message: m.Pose, at: Moment) -> Actions:
    needle.take_plane(plane_from_pose(message.frame_id, message.position, message.orientation))
    return ()


def _is_near(*parts: Any) -> bool:
    """Return whether all numbers are finite, and such that a needle of a rig may have."""
    return all(bool(np.all(np.abs(part) <= _FARTHEST)) for part in parts)


def _parts(pose: m.PoseWithCovariance) -> tuple[Any, Any, Any]:
    """Return place, rotation (None: no orientation) and covariance of the place."""
    covariance = np.array(pose.covariance).reshape(6, 6)[:3, :3]
    return np.array(pose.position), rotation_of(pose), covariance
