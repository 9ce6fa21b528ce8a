"""Which measured tips may move the needle."""

from __future__ import annotations

import dataclasses
import enum
import math

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import RIG
from needle_controller.protocol.joint_history import JointSample

LARGEST_SCALE = 1.15
"""How much farther than the stage moves a needle may go in: a stage's scale can be wrong."""
STAMP_AHEAD_NS = 1_000_000_000
"""A tip's stamp farther ahead of the joints' than this is no time to wait for [ns]."""

_ASYMMETRY = 1e-9
"""Largest difference across the diagonal of a covariance, as a share of its largest entry."""


class Fault(enum.Enum):
    """Faults of a tip; each is counted and logged for itself."""

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


@dataclasses.dataclass(frozen=True)
class TipMeasurement:
    """A measured tip as it came.

    Attributes
    ----------
    stamp_ns : int
        Time of exposure [ns].
    frame_id : str
        Frame of `position`; must be `rig`.
    position : ndarray, shape (3,)
        The tip [m].
    """

    stamp_ns: int
    frame_id: str
    position: Array


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
        Of the position [m^2]; infinite where no tip was found.
    """

    stamp_ns: int
    frame_id: str
    matrix: Array

    def problem(self) -> str:
        """Return why no tip can be used with this, empty if one can."""
        if self.frame_id != RIG:
            return f"needle/tip_pose in frame '{self.frame_id}', wants '{RIG}'"
        if np.any(np.isinf(self.matrix)):
            return "needle/tip_pose says that no tip was found"
        if np.any(np.isnan(self.matrix)):
            return "covariance of needle/tip_pose is not a number"
        largest = float(np.max(np.abs(self.matrix)))
        if np.max(np.abs(self.matrix - self.matrix.T)) > _ASYMMETRY * largest:
            return "covariance of needle/tip_pose is not symmetric"
        least = float(np.linalg.eigvalsh(self.matrix)[0])
        if not least > 0.0:
            return (
                "covariance of needle/tip_pose is not positive definite (its least variance is "
                f"{least:.3g} m^2)"
            )
        return ""


@dataclasses.dataclass(frozen=True)
class AcceptedTip:
    """A tip to be used, with the joints at its exposure.

    Attributes
    ----------
    tip : TipMeasurement
        As it came.
    joints : JointSample
        The joints at its exposure.
    covariance : TipCovariance or None
        What came with it; None for the configured noise.
    """

    tip: TipMeasurement
    joints: JointSample
    covariance: TipCovariance | None = None


@dataclasses.dataclass(frozen=True)
class RefusedTip:
    """A tip that is not used, and why."""

    tip: TipMeasurement
    fault: Fault
    text: str


def refuse_message(tip: TipMeasurement, last: AcceptedTip | None) -> RefusedTip | None:
    """Return why a tip cannot be used whatever the needle did, None if it can.

    Parameters
    ----------
    tip : TipMeasurement
        The tip.
    last : AcceptedTip or None
        The last tip that was used.
    """
    if tip.frame_id != RIG:
        return RefusedTip(tip, Fault.FRAME, f"tip in frame '{tip.frame_id}', wants '{RIG}'")
    if not np.all(np.isfinite(tip.position)):
        return RefusedTip(tip, Fault.NOT_FINITE, f"tip is not finite: {tip.position}")
    if last is not None and tip.stamp_ns <= last.tip.stamp_ns:
        behind = (last.tip.stamp_ns - tip.stamp_ns) * 1e-9
        text = f"tip's stamp is not newer than the last used one's ({behind:g} s behind)"
        return RefusedTip(tip, Fault.NOT_NEWER, text)
    return None


def refuse_stamp(
    tip: TipMeasurement, oldest: JointSample | None, latest: JointSample | None
) -> RefusedTip | None:
    """Return why the joints at a tip's exposure will never be known, None if they may be.

    Parameters
    ----------
    tip : TipMeasurement
        A tip that the joints kept do not bracket.
    oldest, latest : JointSample or None
        The ends of what is kept.
    """
    if oldest is not None and tip.stamp_ns < oldest.stamp_ns:
        return RefusedTip(tip, Fault.BEFORE_JOINTS, "tip is older than any joint_states kept")
    if latest is not None and tip.stamp_ns > latest.stamp_ns + STAMP_AHEAD_NS:
        ahead = (tip.stamp_ns - latest.stamp_ns) * 1e-9
        text = f"tip's stamp is {ahead:.4g} s ahead of joint_states"
        return RefusedTip(tip, Fault.AHEAD_OF_JOINTS, text)
    return None


def refuse_position(
    tip: TipMeasurement, joints: JointSample, last: AcceptedTip | None, margin: float
) -> RefusedTip | None:
    """Return why no needle with these joints can have its tip there, None if one can.

    Parameters
    ----------
    tip : TipMeasurement
        A finite tip in `rig`, whose origin is the entry point.
    joints : JointSample
        The joints at its exposure.
    last : AcceptedTip or None
        The last tip that was used.
    margin : float
        What noise may add [m].
    """
    # Not numpy's norm: what others publish may be too large to be squared.
    distance = math.hypot(*tip.position)
    reach = LARGEST_SCALE * max(joints.insertion, 0.0) + margin
    if distance > reach:
        text = (
            f"tip is {distance:.4g} m from the entry point, wants <= {reach:.4g} m "
            f"({LARGEST_SCALE:g} insertion {joints.insertion:.4g} m + margin {margin:.4g} m)"
        )
        return RefusedTip(tip, Fault.TOO_FAR, text)
    if last is not None:
        jump = math.hypot(*(tip.position - last.tip.position))
        allowed = abs(joints.insertion - last.joints.insertion) + margin
        if jump > allowed:
            text = (
                f"tip jumped {jump:.4g} m since the last used one, wants <= {allowed:.4g} m "
                f"(insertion since then + margin {margin:.4g} m)"
            )
            return RefusedTip(tip, Fault.JUMP, text)
    return None
