"""Which measured tips may move the needle."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_controller.arrays import Array
from needle_controller.joint_history import JointSample
from needle_controller.target_plane import RIG


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
class AcceptedTip:
    """A tip that was used, with the joints at its exposure."""

    tip: TipMeasurement
    joints: JointSample


def refuse_message(tip: TipMeasurement, last: AcceptedTip | None) -> str | None:
    """Return why a tip cannot be used whatever the needle did, None if it can.

    Parameters
    ----------
    tip : TipMeasurement
        The tip.
    last : AcceptedTip or None
        The last tip that was used.
    """
    if tip.frame_id != RIG:
        return f"tip in frame '{tip.frame_id}', wants '{RIG}'"
    if not np.all(np.isfinite(tip.position)):
        return f"tip is not finite: {tip.position}"
    if last is not None and tip.stamp_ns <= last.tip.stamp_ns:
        behind = (last.tip.stamp_ns - tip.stamp_ns) * 1e-9
        return f"tip's stamp is not newer than the last used one's ({behind:g} s behind)"
    return None


def refuse_position(
    tip: TipMeasurement, joints: JointSample, last: AcceptedTip | None, margin: float
) -> str | None:
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
    distance = float(np.linalg.norm(tip.position))
    reach = max(joints.insertion, 0.0) + margin
    if distance > reach:
        return (
            f"tip is {distance:.4g} m from the entry point, wants <= {reach:.4g} m "
            f"(insertion {joints.insertion:.4g} m + margin {margin:.4g} m)"
        )
    if last is not None:
        jump = float(np.linalg.norm(tip.position - last.tip.position))
        allowed = abs(joints.insertion - last.joints.insertion) + margin
        if jump > allowed:
            return (
                f"tip jumped {jump:.4g} m since the last used one, wants <= {allowed:.4g} m "
                f"(insertion since then + margin {margin:.4g} m)"
            )
    return None
