"""Covariances that a source of tips gives with them, by stamp."""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from needle_controller.model.arrays import Array
from needle_controller.model.target_plane import RIG

_KEPT = 64
_SYMMETRY = 1e-9


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
        if np.max(np.abs(self.matrix - self.matrix.T)) > _SYMMETRY * largest:
            return "covariance of needle/tip_pose is not symmetric"
        least = float(np.linalg.eigvalsh(self.matrix)[0])
        if not least > 0.0:
            return (
                "covariance of needle/tip_pose is not positive definite (its least variance is "
                f"{least:.3g} m^2)"
            )
        return ""


class CovarianceHistory:
    """The covariances of the last tips."""

    def __init__(self) -> None:
        self._kept: deque[TipCovariance] = deque(maxlen=_KEPT)

    def add(self, covariance: TipCovariance) -> None:
        """Take one as it came."""
        self._kept.append(covariance)

    def at(self, stamp_ns: int) -> TipCovariance | None:
        """Return that of a stamp, the last one that came; None where there is none."""
        return next((c for c in reversed(self._kept) if c.stamp_ns == stamp_ns), None)

    def has_passed(self, stamp_ns: int) -> bool:
        """Return whether a later stamp's came already: then that of this stamp never will.

        It depends on what came, not on when: topics keep their order.
        """
        return bool(self._kept) and self._kept[-1].stamp_ns > stamp_ns
