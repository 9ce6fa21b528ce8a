"""Visible shape of the needle: the path of the tip, with the pre-bent distal end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from needle_core.errors import UserError
from needle_sim.needle.se3 import FloatArray

# A shorter path is a single point in any image [m].
_MIN_LENGTH = 1e-6


@dataclass(frozen=True)
class NeedleShape:
    """Bevel-tip needle with a pre-bent distal end ([KC09] section II: 0.7 mm, 10 deg at 9 mm).

    The bevel force tilts the distal segment by `lean` towards -y of the tip frame, so that the bend
    lies off the tip's path; behind the bend, the shaft returns to the path on a parabola.

    Parameters
    ----------
    diameter : float
        Diameter of the shaft [m].
    bend_angle : float
        Angle between shaft and distal segment, greater than `lean` [rad].
    bend_distance : float
        Distance from the bend to the tip [m].
    lean : float
        Angle between distal segment and heading, less than `bend_angle`; both are 0 for a straight
        needle [rad].

    Raises
    ------
    UserError
        If `lean` is out of its range.
    """

    diameter: float = 0.0007
    bend_angle: float = float(np.deg2rad(10.0))
    bend_distance: float = 0.009
    lean: float = float(np.deg2rad(5.6))

    def __post_init__(self) -> None:
        """Check the lean."""
        if not (0.0 < self.lean < self.bend_angle or self.lean == self.bend_angle == 0.0):
            raise UserError(
                f"lean = {self.lean:g} rad, expected above 0 and less than the bend of "
                f"{self.bend_angle:g} rad, or 0 as that"
            )

    def lateral_offset(self, distance: FloatArray) -> FloatArray:
        """Return the offset of the shaft from the tip's path, towards +y of the tip frame.

        Parameters
        ----------
        distance : ndarray, shape (...)
            Distance behind the tip [m].

        Returns
        -------
        ndarray, shape (...)
            Offset [m]: by default 0.88 mm at the bend, 0 beyond 32 mm.
        """
        if self.lean == 0.0:
            return np.zeros_like(distance)
        at_bend = self.bend_distance * np.tan(self.lean)
        return_length = 2.0 * at_bend / np.tan(self.bend_angle - self.lean)
        behind_bend = np.clip((distance - self.bend_distance) / return_length, 0.0, 1.0)
        distal = distance * np.tan(self.lean)
        behind = at_bend * (1.0 - behind_bend) ** 2
        return np.asarray(np.where(distance < self.bend_distance, distal, behind))

    def shaft_centreline(
        self,
        T_rig_tip: FloatArray,  # noqa: N803
        centreline: FloatArray,
        spacing: float,
    ) -> FloatArray:
        """Return the centreline of the visible shaft.

        Parameters
        ----------
        T_rig_tip : ndarray, shape (4, 4)
            Pose of the tip [m].
        centreline : ndarray, shape (N, 3)
            Path of the tip in `rig`, from the entry point to the tip [m].
        spacing : float
            Maximum distance between neighbouring points [m].

        Returns
        -------
        ndarray, shape (M, 3)
            Points in `rig`, the last one exactly the tip; empty if the path has no length [m].
        """
        if len(centreline) < 2:
            return np.empty((0, 3))
        from_tip = centreline[::-1]
        steps = np.linalg.norm(np.diff(from_tip, axis=0), axis=1)
        distance_known = np.concatenate([[0.0], np.cumsum(steps)])
        length = distance_known[-1]
        if length < _MIN_LENGTH:
            return np.empty((0, 3))
        distance = np.linspace(length, 0.0, int(np.ceil(length / spacing)) + 1)
        line = np.stack(
            [np.interp(distance, distance_known, from_tip[:, axis]) for axis in range(3)], axis=-1
        )
        line += self.lateral_offset(distance)[:, np.newaxis] * T_rig_tip[:3, 1]
        line[-1] = T_rig_tip[:3, 3]
        return line
