"""The needle on SE(3): motion of the tip under insertion and base rotation, and its path."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray, exp_twist, rotation_about_y, rotation_about_z
from needle_sim.needle.tissue import Torsion

_SEGMENT = np.dtype(
    [
        *(("start", np.float64), ("length", np.float64), ("pose", np.float64, (4, 4))),
        *(("twist", np.float64, 6), ("angle", np.float64), ("turned", np.float64)),
    ]
)


class Channel:
    """Path that the tip of a needle has cut: a chain of constant twists, exact at any length.

    Parameters
    ----------
    T_rig_entry : ndarray, shape (4, 4)
        Pose of the tip frame in `rig` at inserted length 0.
    entry_angle : float
        Angle of the tip at the entry [rad].
    """

    def __init__(self, T_rig_entry: FloatArray, entry_angle: float) -> None:  # noqa: N803
        self._entry_pose = T_rig_entry
        self._entry_angle = entry_angle
        self.length = 0.0
        self._count = 0
        self._segments = np.empty(64, _SEGMENT)

    def append(
        self,
        T_rig_start: FloatArray,  # noqa: N803
        twist: FloatArray,
        length: float,
        angle: float,
        turned: float,
    ) -> None:
        """Append a segment cut with a constant twist.

        Parameters
        ----------
        T_rig_start : ndarray, shape (4, 4)
            Pose of the tip frame at the start of the segment.
        twist : ndarray, shape (6,)
            Body twist over the whole segment.
        length : float
            Length of the segment, above 0 [m].
        angle, turned : float
            Angle of the tip at the start of the segment, and its rotation over the segment [rad].
        """
        if self._count == len(self._segments):
            self._segments = np.concatenate([self._segments, np.empty_like(self._segments)])
        self._segments[self._count] = self.length, length, T_rig_start, twist, angle, turned
        self._count += 1
        self.length += length

    def at(self, insertion: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the poses and angles of the tip frame along the path.

        Before the entry, the path continues straight along the heading of the entry.

        Parameters
        ----------
        insertion : array_like, shape (...)
            Inserted lengths, at most `length` [m].

        Returns
        -------
        T_rig_tip : ndarray, shape (..., 4, 4)
            Poses in `rig`.
        angle : ndarray, shape (...)
            Rotation of the tip about its axis when it cut the path there [rad].
        """
        insertion = np.asarray(insertion, dtype=np.float64)
        if self._count == 0:
            return self._before_entry(insertion), np.full(insertion.shape, self._entry_angle)
        starts = self._segments["start"][: self._count]
        cut = self._segments[np.clip(np.searchsorted(starts, insertion, "right") - 1, 0, None)]
        # A share, because the rate over a very short segment may overflow.
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


# Insertion below which the needle counts as withdrawn [m].
_WITHDRAWN = 1e-6


def initial_pose(pitch: float, roll: float) -> FloatArray:
    """Return the tip's pose at the entry point: R = Rx(0) Ry(pitch) Rz(roll) at rig's origin.

    Parameters
    ----------
    pitch : float
        Pitch of the heading out of the desired plane, towards +x [rad].
    roll : float
        Rotation about the heading [rad].

    Returns
    -------
    ndarray, shape (4, 4)
        T_rig_tip [m].
    """
    return np.asarray(rotation_about_y(pitch) @ rotation_about_z(roll))


class NeedlePlant:
    """Exact plant for [KC09] eqs (1)-(2), for one needle, or many over leading axes.

    A call of `advance` is one combined twist, T <- T exp((V1 dl + V2 dtheta)^): the rotation is
    proportional to the insertion, as with the drives. With torsion, dtheta is the rotation of the
    tip over the call, spread evenly.

    A retracted needle follows its path in reverse: position and heading are those of the path, and
    the tip is rotated about its axis by the base rotation (after torsion) since it cut the path
    there. Inserted again, the needle follows the same channel and continues cutting at its end. A
    withdrawn needle (within 1 um, the accuracy of summed increments) leaves the channel: the next
    insertion cuts a new one at the same entry point. Outside, it moves straight along its heading.

    Parameters
    ----------
    T_rig_tip : array_like, shape (..., 4, 4)
        Pose of the tip at insertion 0, in `rig` [m].
    curvature : array_like, shape (...)
        kappa, the curvature of the path under pure insertion [1/m]; may be changed later.
    torsion : Torsion, optional
        Torsion of the shaft; none by default.

    Raises
    ------
    ValueError
        If the shape of `T_rig_tip` is not (..., 4, 4), or a value is not finite.
    """

    def __init__(
        self,
        T_rig_tip: ArrayLike,  # noqa: N803
        *,
        curvature: ArrayLike,
        torsion: Torsion | None = None,
    ) -> None:
        pose = np.array(T_rig_tip, dtype=np.float64)
        if pose.shape[-2:] != (4, 4):
            raise ValueError(f"T_rig_tip has shape (..., 4, 4), got {pose.shape}")
        self.curvature = np.asarray(curvature, dtype=np.float64)
        if not (np.all(np.isfinite(pose)) and np.all(np.isfinite(self.curvature))):
            raise ValueError(f"T_rig_tip and curvature must be finite, got {pose}, {curvature!r}")
        self._pose = pose
        self._torsion = Torsion() if torsion is None else torsion
        self._insertion: FloatArray = np.zeros(pose.shape[:-2])
        self._channel = Channel(pose, float(self._torsion.tip_angle)) if pose.ndim == 2 else None

    @property
    def T_rig_tip(self) -> FloatArray:  # noqa: N802
        """Pose of the tip in `rig`, shape (..., 4, 4) [m]."""
        return np.array(self._pose)

    @property
    def insertion(self) -> FloatArray:
        """Inserted length, shape (...) [m]; negative outside of the tissue."""
        return np.array(self._insertion)

    @property
    def rotation(self) -> FloatArray:
        """Rotation of the tip about its axis since the start, shape (...) [rad]."""
        return np.array(np.broadcast_to(self._torsion.tip_angle, self._insertion.shape))

    def advance(self, d_insertion: ArrayLike, d_rotation: ArrayLike) -> None:
        """Move the base, and the tip with it.

        Parameters
        ----------
        d_insertion : array_like, shape (...)
            Insertion of the base [m]; a negative value retracts the needle (one needle only).
        d_rotation : array_like, shape (...)
            Rotation of the base over that insertion [rad].

        Raises
        ------
        ValueError
            If an input is not finite, or many needles are retracted.
        """
        length = np.asarray(d_insertion, dtype=np.float64)
        turned = np.asarray(d_rotation, dtype=np.float64)
        if not (np.all(np.isfinite(length)) and np.all(np.isfinite(turned))):
            raise ValueError(f"d_insertion = {length}, d_rotation = {turned} must be finite")
        if self._channel is None:
            if np.any(length < 0.0):
                raise ValueError(f"many needles cannot retract: d_insertion = {length}")
            self._cut(length, self._torsion.advance(length, turned))
        else:
            self._advance_one(self._channel, float(length), float(turned))

    def centreline(self, spacing: float) -> FloatArray:
        """Return the path of the tip from the entry point to its present position.

        Parameters
        ----------
        spacing : float
            Maximum distance between neighbouring points along the path [m].

        Returns
        -------
        ndarray, shape (N, 3)
            Positions in `rig`, the tip last [m]; only the tip if it is outside.

        Raises
        ------
        ValueError
            If `spacing` is not positive, or there are many needles.
        """
        if self._channel is None:
            raise ValueError("only a single needle records its path")
        if not spacing > 0.0:
            raise ValueError(f"spacing = {spacing} m must be above 0")
        insertion = float(self._insertion)
        tip = self._pose[np.newaxis, :3, 3]
        if insertion <= 0.0:
            return np.array(tip)
        count = int(np.ceil(insertion / spacing))
        poses, _ = self._channel.at(np.linspace(0.0, insertion, count + 1)[:-1])
        return np.concatenate([poses[:, :3, 3], tip])

    def _advance_one(self, channel: Channel, length: float, turned: float) -> None:
        start = float(self._insertion)
        in_channel = min(length, max(channel.length - start, 0.0)) if length != 0.0 else 0.0
        if in_channel != 0.0:
            share = in_channel / length
            self._torsion.advance(in_channel, share * turned)
            self._follow(channel, start + in_channel)
            length -= in_channel
            turned -= share * turned
            if length == 0.0:
                return
        angle = float(self._torsion.tip_angle)
        tip_turned = float(self._torsion.advance(length, turned))
        before = self._pose
        twist = self._cut(np.asarray(length), np.asarray(tip_turned))
        if length > 0.0:
            channel.append(before, twist, length, angle, tip_turned)

    def _follow(self, channel: Channel, insertion: float) -> None:
        """Move the tip along its path; its roll differs by the rotation since the path was cut."""
        path, angle = channel.at(insertion)
        tip_angle = float(self._torsion.tip_angle)
        self._pose = np.asarray(path @ rotation_about_z(tip_angle - angle))
        self._insertion = np.asarray(insertion)
        if insertion <= _WITHDRAWN:
            entry, angle = channel.at(0.0)
            entry = np.asarray(entry @ rotation_about_z(tip_angle - angle))
            self._channel = Channel(entry, tip_angle)
            if insertion > 0.0:
                straight = np.array([0.0, 0.0, insertion, 0.0, 0.0, 0.0])
                self._channel.append(entry, straight, insertion, tip_angle, 0.0)

    def _cut(self, length: FloatArray, tip_turned: FloatArray) -> FloatArray:
        """Move the tip by the twist V1 dl + V2 dtheta of [KC09] eq. (2), and return the twist."""
        shape = np.broadcast_shapes(self._insertion.shape, length.shape, tip_turned.shape)
        twist = np.zeros((*shape, 6))
        # V1 = [0, 0, 1, kappa, 0, 0] of the unicycle, whose tip is frame B's origin (l2 = 0).
        twist[..., 2] = length
        twist[..., 3] = self.curvature * length
        twist[..., 5] = tip_turned
        self._pose = np.asarray(self._pose @ exp_twist(twist))
        self._insertion = self._insertion + length
        return twist
