"""Checks that decide whether a measured tip may be used for steering."""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import RIG, UNIT_TOLERANCE
from needle_controller.protocol.joint_history import JointSample
from needle_core.messages import Point

LARGEST_SCALE = 1.15
"""Largest insertion of the needle per insertion of the stage, whose scale may be wrong."""
STAMP_AHEAD_NS = 1_000_000_000
"""Largest time by which a tip's stamp may be ahead of the joints [ns]."""
_ASYMMETRY = 1e-9
"""Largest difference across the diagonal of a covariance, relative to its largest entry."""


class TipFault(enum.Enum):
    """Reasons to reject a tip; each is counted and logged separately."""

    FRAME = "frame"
    NOT_FINITE = "not_finite"
    NOT_NEWER = "not_newer"
    TOO_FAR = "too_far"
    JUMP = "jump"
    BEFORE_JOINTS = "before_joints"
    AHEAD_OF_JOINTS = "ahead_of_joints"
    NO_JOINTS = "no_joints"
    NO_COVARIANCE = "no_covariance"
    BAD_COVARIANCE = "bad_covariance"


Heading = tuple[Array, float]
"""Direction of the tip in `rig`, shape (3,), and the variance of its angle [rad^2]."""


@dataclasses.dataclass(frozen=True)
class TipCovariance:
    """Covariance from needle/tip_pose of the tip with the same stamp.

    Attributes
    ----------
    stamp_ns : int
        Time of exposure [ns].
    frame_id : str
        Frame of the covariance; must be `rig`.
    matrix : ndarray, shape (3, 3)
        Covariance of the position [m^2]; infinite if no tip was found.
    heading : Heading, optional
        Measured heading, if any.
    """

    stamp_ns: int
    frame_id: str
    matrix: Array
    heading: Heading | None = None

    def problem(self) -> str:
        """Return why the covariance cannot be used; empty if it can."""
        if self.frame_id != RIG:
            return f"needle/tip_pose in frame '{self.frame_id}', expected '{RIG}'"
        if np.any(np.isinf(self.matrix)):
            return "needle/tip_pose reports that no tip was found"
        if np.any(np.isnan(self.matrix)):
            return "covariance of needle/tip_pose is not a number"
        largest = float(np.max(np.abs(self.matrix)))
        if np.max(np.abs(self.matrix - self.matrix.T)) > _ASYMMETRY * largest:
            return "covariance of needle/tip_pose is not symmetric"
        least = float(np.linalg.eigvalsh(self.matrix)[0])
        if not least > 0.0:
            return (
                "covariance of needle/tip_pose is not positive definite (its smallest variance is "
                f"{least:.3g} m^2)"
            )
        return self._heading_problem()

    def _heading_problem(self) -> str:
        direction, variance = self.heading or (np.array([0.0, 0.0, 1.0]), 1.0)
        length = math.hypot(*direction)
        if abs(length - 1.0) < UNIT_TOLERANCE and 0.0 < variance < math.inf:
            return ""
        return f"heading of needle/tip_pose: length {length:.3g}, variance {variance:.3g} rad^2"


@dataclasses.dataclass(frozen=True)
class AcceptedTip:
    """A tip that may be used, with the joint positions at its exposure.

    Attributes
    ----------
    tip : Point
        Tip as received; its stamp is the time of exposure.
    joints : JointSample
        Joint positions at its exposure.
    covariance : TipCovariance or None
        Its covariance; None for the configured noise.
    """

    tip: Point
    joints: JointSample
    covariance: TipCovariance | None = None


@dataclasses.dataclass(frozen=True)
class RejectedTip:
    """A tip that must not be used, and the reason."""

    tip: Point
    fault: TipFault
    text: str


def check_message(tip: Point, last: AcceptedTip | None) -> RejectedTip | None:
    """Check a tip independently of the joints; return the rejection, or None.

    Parameters
    ----------
    tip : Point
        The tip.
    last : AcceptedTip or None
        The last tip that was used.
    """
    if tip.frame_id != RIG:
        return RejectedTip(tip, TipFault.FRAME, f"tip in frame '{tip.frame_id}', expected '{RIG}'")
    if not np.all(np.isfinite(tip.position)):
        return RejectedTip(tip, TipFault.NOT_FINITE, f"tip is not finite: {tip.position}")
    if last is not None and tip.stamp_ns <= last.tip.stamp_ns:
        behind = (last.tip.stamp_ns - tip.stamp_ns) * 1e-9
        text = f"tip's stamp is not newer than the last used one's ({behind:g} s behind)"
        return RejectedTip(tip, TipFault.NOT_NEWER, text)
    return None


def check_stamp(
    tip: Point, oldest: JointSample | None, latest: JointSample | None
) -> RejectedTip | None:
    """Check that joint samples cover a tip's exposure; return the rejection.

    Parameters
    ----------
    tip : Point
        A tip whose stamp lies outside the joint history.
    oldest, latest : JointSample or None
        Ends of the history.
    """
    if oldest is not None and tip.stamp_ns < oldest.stamp_ns:
        return RejectedTip(tip, TipFault.BEFORE_JOINTS, "tip is older than all stored joint_states")
    if latest is not None and tip.stamp_ns > latest.stamp_ns + STAMP_AHEAD_NS:
        ahead = (tip.stamp_ns - latest.stamp_ns) * 1e-9
        text = f"tip's stamp is {ahead:.4g} s ahead of joint_states"
        return RejectedTip(tip, TipFault.AHEAD_OF_JOINTS, text)
    return None


def check_position(
    tip: Point, joints: JointSample, last: AcceptedTip | None, margin: float
) -> RejectedTip | None:
    """Check that a needle at these joint positions can have its tip there; return the rejection.

    Parameters
    ----------
    tip : Point
        A finite tip in `rig`, whose origin is the entry point.
    joints : JointSample
        Joint positions at its exposure.
    last : AcceptedTip or None
        The last tip that was used.
    margin : float
        Tolerance for measurement noise [m].
    """
    # Not numpy's norm: the square of a huge received value would overflow.
    distance = math.hypot(*tip.position)
    reach = LARGEST_SCALE * max(joints.insertion, 0.0) + margin
    if distance > reach:
        text = (
            f"tip is {distance:.4g} m from the entry point, limit {reach:.4g} m "
            f"({LARGEST_SCALE:g} insertion {joints.insertion:.4g} m + margin {margin:.4g} m)"
        )
        return RejectedTip(tip, TipFault.TOO_FAR, text)
    if last is None:
        return None
    jump = math.dist(tip.position, last.tip.position)
    allowed = abs(joints.insertion - last.joints.insertion) + margin
    if jump <= allowed:
        return None
    text = (
        f"tip jumped {jump:.4g} m since the last used one, limit {allowed:.4g} m "
        f"(insertion since then + margin {margin:.4g} m)"
    )
    return RejectedTip(tip, TipFault.JUMP, text)
