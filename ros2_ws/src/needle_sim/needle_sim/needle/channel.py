"""The path the tip has cut: a chain of constant twists that gives any pose on it exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray, exp_twist


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
        self._starts = np.empty(64)
        self._lengths = np.empty(64)
        self._poses = np.empty((64, 4, 4))
        self._twists = np.empty((64, 6))
        self._angles = np.empty((64, 2))

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
        if self._count == len(self._starts):
            self._starts = np.concatenate([self._starts, np.empty_like(self._starts)])
            self._lengths = np.concatenate([self._lengths, np.empty_like(self._lengths)])
            self._poses = np.concatenate([self._poses, np.empty_like(self._poses)])
            self._twists = np.concatenate([self._twists, np.empty_like(self._twists)])
            self._angles = np.concatenate([self._angles, np.empty_like(self._angles)])
        self._starts[self._count] = self.length
        self._poses[self._count] = T_rig_start
        self._lengths[self._count] = length
        self._twists[self._count] = twist
        self._angles[self._count] = angle, turned
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
        starts = self._starts[: self._count]
        index = np.clip(np.searchsorted(starts, insertion, side="right") - 1, 0, None)
        # A share, since a rate over the shortest of stretches is beyond numbers.
        lengths = self._lengths[index]
        share = np.clip(insertion - starts[index], 0.0, lengths) / lengths
        poses = self._poses[index] @ exp_twist(share[..., np.newaxis] * self._twists[index])
        angles = self._angles[index, 0] + share * self._angles[index, 1]
        outside = insertion < 0.0
        poses[outside] = self._before_entry(insertion[outside])
        return poses, np.where(outside, self._entry_angle, angles)

    def _before_entry(self, insertion: FloatArray) -> FloatArray:
        straight = np.zeros((*insertion.shape, 6))
        straight[..., 2] = insertion
        return np.asarray(self._entry_pose @ exp_twist(straight))
