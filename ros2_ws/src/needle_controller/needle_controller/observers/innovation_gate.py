"""Which measured tips an estimator takes: the innovation gate, one rule for all estimators."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from needle_common.errors import OutOfBoundsError
from needle_controller.model.arrays import Array

Mask = npt.NDArray[np.bool_]

TIPS_UNTIL_REACCEPTANCE = 4


class InnovationGate:
    """Refuses tips too far from where they were expected, but not for ever.

    A tip is refused when its squared Mahalanobis distance from the expected one is above `limit`.
    After `tips_until_reacceptance` refusals in a row the next tip is taken all the same: then it is
    the estimate that is off. Needles (leading axes) are judged one by one.

    Parameters
    ----------
    limit : float
        Largest squared distance [-]; infinite takes everything.
    tips_until_reacceptance : int
        Refusals in a row after which a tip is taken.

    Raises
    ------
    OutOfBoundsError
        A limit not above 0, or fewer than 1 refusals.
    """

    def __init__(
        self, limit: float, tips_until_reacceptance: int = TIPS_UNTIL_REACCEPTANCE
    ) -> None:
        if not limit > 0.0:
            raise OutOfBoundsError("gate", limit, 0.0, math.inf, "-")
        if tips_until_reacceptance < 1:
            raise OutOfBoundsError(
                "tips_until_reacceptance", tips_until_reacceptance, 1, math.inf, "-"
            )
        self.limit = limit
        self.tips_until_reacceptance = tips_until_reacceptance
        self._refused: npt.NDArray[np.int64] = np.zeros((), dtype=np.int64)

    def reset(self) -> None:
        """Forget the refusals."""
        self._refused = np.zeros((), dtype=np.int64)

    def admit(self, squared_distance: Array, found: Mask) -> Mask:
        """Return which tips to use.

        Parameters
        ----------
        squared_distance : ndarray, shape (...)
            Squared Mahalanobis distance of each tip from the expected one; NaN where not found.
        found : ndarray of bool, shape (...)
            Where there is a tip at all.

        Returns
        -------
        ndarray of bool, shape (...)
            True where the tip is to be used.
        """
        inside = squared_distance <= self.limit
        used = found & (inside | (self._refused >= self.tips_until_reacceptance))
        refused = np.where(found, self._refused + 1, self._refused)
        self._refused = np.where(used, 0, refused)
        return np.asarray(used)

    def warnings(self) -> tuple[str, ...]:
        """Return what a user should know: how many tips were refused in a row, if any."""
        most = int(np.max(self._refused))
        if most == 0:
            return ()
        return (f"tip refused by the innovation gate, {most} in a row",)
