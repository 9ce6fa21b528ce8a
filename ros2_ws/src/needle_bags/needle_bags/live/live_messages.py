"""Messages of the live view, in `rig`."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from needle_bags.live.live_needle import LiveNeedle, MeasuredTip
from needle_controller.model.target_plane import RIG
from needle_core import messages as m
from needle_core.rotations import quaternion_from_rotation

Array = NDArray[np.float64]

TARGET_FRAME, TIP_FRAME = "target_plane", "needle_tip"
# Constants of visualization_msgs/Marker.
ARROW, CUBE, SPHERE, LINE_STRIP = 0, 1, 2, 4
ADD, DELETE = 0, 2
# Sizes of the markers, large enough to be visible [m].
_SHAFT, _TIP, _POINT = 1e-3, 2.5e-3, 4e-3
_ARROW = (2e-2, 8e-4, 8e-4)
_PLANE = (2e-4, 8e-2, 2e-1)
_PLANE_CENTRE = 1e-1
# Blue, orange, yellow and grey are also distinguishable with red-green colour blindness.
_BLUE, _ORANGE, _YELLOW, _GREY = (0.2, 0.6, 1.0), (1.0, 0.6, 0.1), (1.0, 0.9, 0.2), (0.7, 0.7, 0.7)
# Scale of the 95 % ellipsoid: square root of chi-squared with three degrees of freedom.
SIGMAS = 2.7955
_ORIGIN, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def to_tip(tip: MeasuredTip) -> m.Pose:
    """Return the pose of the measured tip; its z axis is the shaft."""
    x, y, z, w = tip.quaternion.tolist()
    return m.Pose(tip.stamp_ns, RIG, _xyz(tip.position), (x, y, z, w))


def to_path(path: Array, stamp_ns: int) -> m.Path:
    """Return the path of the tip, shape (n, 3) [m]."""
    return m.Path(stamp_ns, RIG, tuple(map(_xyz, path)))


def to_markers(needle: LiveNeedle, stamp_ns: int) -> m.Markers:
    """Return shaft, tip, estimate, its 95 % ellipsoid, plane and target point.

    Markers of unknown quantities are deleted.
    """
    shaft, estimate, plane, point = needle.shaft, needle.estimate, needle.plane, needle.target_point
    uncertain = needle.tip if estimate is None else estimate
    drawn: dict[str, m.Marker] = {}

    def draw(
        name: str,
        kind: int,
        scale: m.Vector3,
        colour: m.Vector3,
        opacity: float = 1.0,
        *,
        at: m.Vector3 = _ORIGIN,
        turn: m.Quaternion = _UPRIGHT,
        points: tuple[m.Vector3, ...] = (),
        action: int = ADD,
    ) -> None:
        drawn[name] = m.Marker(
            RIG, name, 0, kind, action, at, turn, scale, stamp_ns, (*colour, opacity), points
        )

    if shaft is not None:
        points = tuple(map(_xyz, shaft))
        colour = _BLUE if needle.tip_found else _GREY
        draw("shaft", LINE_STRIP, (_SHAFT, 0.0, 0.0), _BLUE, points=points)
        draw("tip", SPHERE, (_TIP,) * 3, colour, at=points[-1])
    if estimate is not None:
        end = estimate.position + _ARROW[0] * estimate.rotation[:, 2]
        ends = (_xyz(estimate.position), _xyz(end))
        draw("estimate", ARROW, (_ARROW[1], 2.0 * _ARROW[2], 0.0), _ORANGE, points=ends)
    if uncertain is not None:
        axes, lengths = ellipsoid(uncertain.covariance)
        at, turn = _xyz(uncertain.position), quaternion_from_rotation(axes.tolist())
        draw("uncertainty", SPHERE, _xyz(2.0 * lengths), _ORANGE, 0.35, at=at, turn=turn)
    if plane is not None:
        rotation = plane.T_rig_plane[:3, :3]
        centre = _xyz(plane.T_rig_plane[:3, 3] + _PLANE_CENTRE * rotation[:, 2])
        turn = quaternion_from_rotation(rotation.tolist())
        draw("plane", CUBE, _PLANE, _YELLOW, 0.25, at=centre, turn=turn)
    if point is not None:
        draw("target_point", SPHERE, (_POINT,) * 3, _YELLOW, at=_xyz(point))
    for name in ("shaft", "tip", "estimate", "uncertainty", "plane", "target_point"):
        if name not in drawn:
            draw(name, ARROW, _ORIGIN, _GREY, action=DELETE)
    return m.Markers(tuple(drawn.values()))


def to_transforms(needle: LiveNeedle, stamp_ns: int) -> m.Transforms | None:
    """Return the known poses of plane, measured tip and the URDF's moving links; None if none."""
    found = []
    if needle.plane is not None:
        found.append(_transform(needle.plane.T_rig_plane, RIG, TARGET_FRAME, stamp_ns))
    if needle.tip is not None:
        tip = to_tip(needle.tip)
        found.append(m.Transform(tip.stamp_ns, RIG, TIP_FRAME, tip.position, tip.orientation))
    at = dict(zip(needle.joints.names, needle.joints.positions, strict=False))
    insertion, half = at.get(m.INSERTION_JOINT, math.nan), 0.5 * at.get(m.ROTATION_JOINT, math.nan)
    if math.isfinite(insertion + half):
        turn = (0.0, 0.0, math.sin(half), math.cos(half))
        stamp_ns = needle.joints.stamp_ns
        found.append(m.Transform(stamp_ns, "stage", "carriage", (0.0, 0.0, insertion), _UPRIGHT))
        found.append(m.Transform(stamp_ns, "carriage", "shaft", _ORIGIN, turn))
    return m.Transforms(tuple(found)) if found else None


def fixed_transforms(bodies: Mapping[str, Array], stamp_ns: int) -> m.Transforms:
    """Return the poses of the URDF's fixed links, given the camera bodies' poses by side."""
    links = ("phantom", "stage")
    found = [m.Transform(stamp_ns, RIG, link, _ORIGIN, _UPRIGHT) for link in links]
    for side, pose in bodies.items():
        found.append(_transform(pose, RIG, f"{side}_camera", stamp_ns))
        optical = (f"{side}_camera", camera_frame(side), _ORIGIN, (-0.5, 0.5, -0.5, 0.5))
        found.append(m.Transform(stamp_ns, *optical))
    return m.Transforms(tuple(found))


def camera_frame(side: str) -> str:
    """Return the name of a camera's optical frame."""
    return f"{side}_camera_optical"


def _transform(matrix: Array, parent: str, child: str, stamp_ns: int) -> m.Transform:
    turn = quaternion_from_rotation(matrix[:3, :3].tolist())
    return m.Transform(stamp_ns, parent, child, _xyz(matrix[:3, 3]), turn)


def _xyz(values: Array) -> m.Vector3:
    """Return Python floats, because rclpy sends numpy scalars of another width as garbage."""
    x, y, z = values.tolist()
    return (x, y, z)


def ellipsoid(covariance: Array) -> tuple[Array, Array]:
    """Return the ellipsoid that contains 95 % of a normal distribution.

    Parameters
    ----------
    covariance : ndarray, shape (3, 3)
        Covariance of a position [m^2].

    Returns
    -------
    axes : ndarray, shape (3, 3)
        Directions of the half axes as columns, right-handed.
    lengths : ndarray, shape (3,)
        Lengths of the half axes [m].
    """
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0.0:
        axes = axes * [1.0, 1.0, -1.0]
    return axes, SIGMAS * np.sqrt(np.maximum(variances, 0.0))
