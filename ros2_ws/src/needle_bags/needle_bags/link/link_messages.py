"""The needle as OpenIGTLink messages, in `rig` and, as that protocol has it, in mm."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_bags.live.live_needle import LiveNeedle

TIP, ESTIMATE, PLANE = "NeedleTipToRig", "NeedleEstimateToRig", "TargetPlaneToRig"
SHAFT, TARGET, STATUS = "NeedleShaft", "NeedleTarget", "NeedleStatus"
_MM = 1e3
# A shaft of more is thinned out: a viewer draws a line through them.
_MOST_POINTS = 25


def packed(needle: LiveNeedle, now: float) -> bytes:
    """Return all there is to be said of a needle, one message after the other.

    What is not known, or not seen any longer, is not said; `NeedleStatus` says so.

    Parameters
    ----------
    needle : LiveNeedle
        What is known.
    now : float
        Time [s] since 1970; a tip has the time of its exposure.
    """
    # An extra: what else is made of this package does without.
    import pyigtl.messages as igtl  # noqa: PLC0415

    said: list[Any] = [igtl.StringMessage(_status(needle), now, STATUS)]
    tip, plane, belief = needle.tip, needle.plane, needle.belief
    if tip is not None and needle.is_seen:
        rotation = Rotation.from_quat(tip.quaternion).as_matrix()
        matrix = _matrix(rotation, tip.place)
        said.append(igtl.TransformMessage(matrix, tip.stamp_ns * 1e-9, TIP))
    if belief is not None:
        said.append(igtl.TransformMessage(_matrix(belief.rotation, belief.place), now, ESTIMATE))
    if plane is not None:
        matrix = _matrix(plane.T_rig_plane[:3, :3], plane.T_rig_plane[:3, 3])
        said.append(igtl.TransformMessage(matrix, now, PLANE))
    points = {SHAFT: needle.shaft if needle.is_seen else None, TARGET: needle.target_point}
    for name, places in points.items():
        if places is not None:
            at = _thinned(np.atleast_2d(places)) * _MM
            names = [f"{name}_{number}" for number in range(len(at))]
            said.append(igtl.PointMessage(at, names, timestamp=now, device_name=name))
    return b"".join(message.pack() for message in said)


def _status(needle: LiveNeedle) -> str:
    if needle.answered_ns is None:
        return "nothing heard of the needle"
    return "tip found" if needle.is_seen else "no tip found"


def _matrix(rotation: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, place * _MM
    return matrix


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return at most so many points, both ends among them."""
    count = min(len(points), _MOST_POINTS)
    return np.asarray(points[np.round(np.linspace(0, len(points) - 1, count)).astype(int)])
