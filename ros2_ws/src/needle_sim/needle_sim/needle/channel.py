"""The path the tip has cut: a chain of constant twists that gives any pose on it exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray, exp_twist

_STRETCH = np.dtype(
    [
        *(("start", np.float64), ("length", np.float64), ("pose", np.float64, (4, 4))),
        *(("twist", np.float64, 6), ("angle", np.float64), ("turned", np.float64)),
    ]
)


class Channel:
    """Poses of one needle's tip frame along the path it cut, by inserted length.

    Parameters
    ----------
    T_rig_entry : ndarray, shape (4, 4)
        Pose of the tip frame in `rig` at inserted length 0.
    entry_angle : float
        The tip's angle there [rad].
    """

    def __init__(self, T_rig_entry: FloatArray, entry_angle: float) -> None:  # noqa: N803
        self._entry_pose = T_rig_entry
        self._entry_angle = entry_angle
        self.length = 0.0
        self._count = 0
        self._stretches = np.empty(64, _STRETCH)

    def append(
        self,
        T_rig_start: FloatArray,  # noqa: N803
        twist: FloatArray,
        length: float,
        angle: float,
        turned: float,
    ) -> None:
        """Add a stretch cut with a constant twist.

        Parameters
        ----------
        T_rig_start : ndarray, shape (4, 4)
            Pose of the tip frame where the stretch begins.
        twist : ndarray, shape (6,)
            Body twist over the whole stretch.
        length : float
            Insertion over the stretch, above 0 [m].
        angle, turned : float
            The tip's angle where the stretch begins, and its rotation over the stretch [rad].
        """
        if self._count == len(self._stretches):
            self._stretches = np.concatenate([self._stretches, np.empty_like(self._stretches)])
        self._stretches[self._count] = self.length, length, T_rig_start, twist, angle, turned
        self._count += 1
        self.length += length

    def at(self, insertion: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the tip frame's poses and angles as the path was cut.

        Before the entry the path goes on straight along the entry's heading.

        Parameters
        ----------
        insertion : array_like, shape (...)
            Inserted lengths, at most `length` [m].

        Returns
        -------
        T_rig_tip : ndarray, shape (..., 4, 4)
            Poses in `rig`.
        angle : ndarray, shape (...)
            Rotation of the tip about its axis when it passed there [rad].
        """
        insertion = np.asarray(insertion, dtype=np.float64)
        if self._count == 0:
            return self._before_entry(insertion), np.full(insertion.shape, self._entry_angle)
        starts = self._stretches["start"][: self._count]
        cut = self._stretches[np.clip(np.searchsorted(starts, insertion, "right") - 1, 0, None)]
        # A share, since a rate over the shortest of stretches is beyond numbers.
        share = np.clip(insertion - cut["start"], 0.0, cut["length"]) / cut["length"]
        path = np.ascontiguousarray(cut["pose"])
        poses = path @ exp_twist(share[..., np.newaxis] * cut["twist"])
        angles = cut["angle"] + share * cut["turned"]
        outside = insertion < 0.0
        poses[outside] = self._before_entry(insertion[outside])
        return poses, np.where(outside, self._entry_angle, angles)

    def _before_entry(self, insertion: FloatArray) -> FloatArray:
        straight = np.zeros((*insertion.shape, 6))
        straight[..., 2] = insertion
        return np.asarray(self._entry_pose @ exp_twist(straight))
