"""Current state of the needle, collected from the topics of the rig."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_bags.run.shaft_trail import ShaftTrail
from needle_controller.model.target_plane import TargetPlane, offset_plane
from needle_core import messages as m
from needle_core.rotations import rotation_from_quaternion
from needle_tracker.optics.calibration import pose_matrix

Array = NDArray[np.float64]

# A requested plane is in force if its offset agrees with the controller's within this [m].
_SAME_OFFSET = 1e-6
# Estimates are outdated if they end more than this short of the measured tips [m].
_OUTDATED = 5e-3
# After a withdrawal by more than this, the last estimate no longer applies [m].
_WITHDRAWN = 5e-4


@dataclasses.dataclass(frozen=True)
class MeasuredTip:
    """A tip that the tracker found.

    Attributes
    ----------
    stamp_ns : int
        Time of exposure [ns].
    position : ndarray, shape (3,)
        Position in `rig` [m].
    quaternion : ndarray, shape (4,)
        Orientation x, y, z, w of the frame whose z axis is along the shaft.
    covariance : ndarray, shape (3, 3)
        Covariance of the position [m^2].
    """

    stamp_ns: int
    position: Array
    quaternion: Array
    covariance: Array

    @property
    def pose(self) -> Array:
        """Pose in `rig`, shape (4, 4)."""
        unit = self.quaternion / np.linalg.norm(self.quaternion)
        return pose_matrix(rotation_from_quaternion(unit), self.position)


@dataclasses.dataclass(frozen=True)
class TipEstimate:
    """The controller's estimate of the tip.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Position of the tip [m].
    rotation : ndarray, shape (3, 3)
        Axes of the tip's frame as columns; the third is the heading.
    covariance : ndarray, shape (3, 3)
        Covariance of the position [m^2].
    stamp_ns : int
        Exposure time of the measured tip behind the estimate [ns].
    """

    position: Array
    rotation: Array
    covariance: Array
    stamp_ns: int = 0

    @property
    def pose(self) -> Array:
        """Pose of the tip's frame, shape (4, 4)."""
        return pose_matrix(self.rotation, self.position)


class LiveNeedle:
    """State of the needle.

    Attributes
    ----------
    tip : MeasuredTip or None
        The last tip that was found.
    answered_ns : int or None
        Exposure time of the tracker's last answer, with or without a tip [ns].
    tip_found : bool
        Whether that answer contained a tip.
    target_point : ndarray, shape (3,), or None
        The target point, in `rig` [m].
    joints : JointState
        Last joint positions; empty before the first message.
    planned_path : Path or None
        Path that the controller has planned around obstacles, from the tip to the target; it
        belongs to the estimate with the same stamp.
    """

    def __init__(self) -> None:
        self.tip: MeasuredTip | None = None
        self.answered_ns: int | None = None
        self.tip_found = False
        self.target_point: Array | None = None
        self.joints = m.JointState(0, (), ())
        self.planned_path: m.Path | None = None
        self._estimate: TipEstimate | None = None
        self._requested_plane: TargetPlane | None = None
        self._offset: float | None = None
        self._insertion = 0.0
        self._trail, self._estimates = ShaftTrail(np.eye(4)), ShaftTrail(np.eye(4))
        self._estimated_at = 0.0

    def set_insertion(self, insertion: float) -> None:
        """Set the insertion depth [m]."""
        self._insertion = insertion

    def add_tip(self, tip: MeasuredTip) -> None:
        """Add a measured tip."""
        self.tip, self.answered_ns, self.tip_found = tip, tip.stamp_ns, True
        self._trail.add(self._insertion, tip.pose)

    def add_missing_tip(self, stamp_ns: int) -> None:
        """Record that no tip was found in an exposure [ns]."""
        self.answered_ns, self.tip_found = stamp_ns, False

    def set_estimate(self, estimate: TipEstimate) -> None:
        """Set the controller's estimate, in `target_plane`."""
        self._estimate, self._estimated_at = estimate, self._insertion
        if self.estimate is not None:
            self._estimates.add(self._insertion, self.estimate.pose)

    def request_plane(self, plane: TargetPlane) -> None:
        """Store a requested target plane; the controller may reject it."""
        self._requested_plane = plane

    def set_targets(self, offset: float | None, point: Array | None) -> None:
        """Set the offset of the target plane [m] and the target point that are in force."""
        self._offset, self.target_point = offset, point

    @property
    def plane(self) -> TargetPlane | None:
        """The target plane; None before the first controller status."""
        if self._offset is None:
            return None
        requested = self._requested_plane
        if requested is not None and abs(requested.offset - self._offset) <= _SAME_OFFSET:
            return requested
        return offset_plane(self._offset)

    @property
    def estimate(self) -> TipEstimate | None:
        """The controller's estimate, in `rig`; None before the first one."""
        plane, estimate = self.plane, self._estimate
        if plane is None or estimate is None:
            return None
        rotation, origin = plane.T_rig_plane[:3, :3], plane.T_rig_plane[:3, 3]
        return TipEstimate(
            position=rotation @ estimate.position + origin,
            rotation=rotation @ estimate.rotation,
            covariance=rotation @ estimate.covariance @ rotation.T,
            stamp_ns=estimate.stamp_ns,
        )

    @property
    def path(self) -> Array:
        """Path of the tip in `rig` [m], shape (n, 3)."""
        return self._trail.path[:, :3, 3]

    @property
    def shaft(self) -> Array | None:
        """Shaft in `rig`, from the entry to the tip [m], shape (n, 3); None without a tip."""
        if self.tip is None:
            return None
        return self._trail.shaft(self._insertion, self.tip.pose)[:, :3, 3]

    @property
    def shape(self) -> tuple[int, Array] | None:
        """Stamp [ns] and poses along the shaft in `rig`, from the entry to the tip, or None.

        Shape (n, 4, 4); z is the tangent. The shaft follows the estimated tips, or the measured
        ones if there is no estimate; during a withdrawal, it ends at the measured tip.
        """
        estimate, trail = self.estimate, self._trail
        if estimate is not None and self._estimates.depth >= trail.depth - _OUTDATED:
            trail = self._estimates
            if self._insertion >= self._estimated_at - _WITHDRAWN:
                return estimate.stamp_ns, trail.shaft(self._insertion, estimate.pose)
        if self.tip is None or not self.tip_found:
            return None
        return self.tip.stamp_ns, trail.shaft(self._insertion, self.tip.pose)
