"""Uncertainty of the needle's end beyond what the fit of one pair says.

A line ends where its darkness ends: where a ground face looks like the floor, both images end short
by as much, and where light falls on one side of the needle, the line lies to the other in both. A
map knows more of faces, and less of where the needle's middle is. No residual tells. What can be
lost in that way is a share of the needle's width, and no more than a face of known length hides.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.image.end_fit import hidden_sigma
from needle_tracker.image.shaft import shaft_length
from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.triangulation import SpatialTip

Array = NDArray[np.float64]

_PITCH = 2e-3  # of points along the shaft [m]
_LEAST_POINTS = 4
_PLAINLY = 3.0  # standard deviations
_SLIP = 0.01  # of the insertion, between pairs of a run [-]


@dataclasses.dataclass(frozen=True)
class Unseen:
    """Standard deviations of what no fit tells, as seen in path-traced pairs.

    Attributes
    ----------
    along : float
        Along the shaft [needle widths].
    across : float
        Across it in an image [needle widths].
    by_face : bool
        Whether an end lies short because of a ground face.
    """

    along: float
    across: float
    by_face: bool = True


OF_OUTLINE = Unseen(0.2, 0.01)
"""Of a line that stands out as a whole."""
OF_LAMP = Unseen(1.0, 0.1, by_face=False)
"""Of a lamp that the needle mirrors: it ends and lies where light has it."""
OF_MAP = Unseen(0.25, 0.08)


class Claims:
    """Adds to a tip's covariance what no fit can know.

    Parameters
    ----------
    views : pair of RefractedCamera
        Left and right.
    needle_widths_px : pair of float
        Width of the needle in the left and the right image [px].
    needle_width : float
        The needle's diameter [m].
    bevel_length : float
        Of its ground face, along the shaft [m]; 0 where unknown.
    """

    def __init__(
        self,
        views: tuple[RefractedCamera, RefractedCamera],
        needle_widths_px: tuple[float, float],
        needle_width: float,
        bevel_length: float,
    ) -> None:
        self._views = views
        self._needle_widths_px = needle_widths_px
        self._needle_width = needle_width
        self._bevel_length = bevel_length

    def widened(self, tip: SpatialTip, unseen: Unseen) -> SpatialTip:
        """Return the tip with as large a covariance as it has to claim.

        Parameters
        ----------
        tip : SpatialTip
            What the fit says.
        unseen : Unseen
            What it cannot say.
        """
        ahead = tip.direction
        normal = np.zeros((3, 3))
        for view, width in zip(self._views, self._needle_widths_px, strict=True):
            jacobian = view.jacobian(tip.position)
            line = jacobian @ ahead
            beside = np.array([-line[1], line[0]]) @ jacobian
            normal += np.outer(beside, beside) / (line @ line * (unseen.across * width) ** 2)
        # Lines say nothing along the shaft, so `normal` has no part of it either.
        claimed = np.linalg.pinv(normal, hermitian=True, rtol=1e-9)
        along = unseen.along * self._needle_width
        if unseen.by_face:
            along = hidden_sigma(along, self._bevel_length)
        claimed += np.outer(ahead, ahead) * along**2
        return dataclasses.replace(tip, covariance=tip.covariance + claimed)


class StagedEnd:
    """The stage's word on an end that is seen badly: the needle is as long as it was pushed in.

    A stage's zero is off by as much in all pairs of a run. The end that was seen best in it says by
    how much, as far as it knows better than what a zero is worth. Faces that are unseen make ends
    lie short again and again: they are not averaged, and an end farther out says more.

    Parameters
    ----------
    zero_sigma : float
        Standard deviation of where the stage's zero is along the needle [m].
    margin : float
        A shaft that is longer or shorter than the insertion by more was not seen as a whole [m].
    """

    def __init__(self, zero_sigma: float, margin: float) -> None:
        self._zero_variance = zero_sigma * zero_sigma
        self._margin = margin
        self.forget()

    def forget(self) -> None:
        """Begin a new run."""
        self._shaft = np.empty((0, 3))
        self._best: _Offset | None = None

    def placed(self, tip: SpatialTip, shaft: Array | None, insertion: float | None) -> SpatialTip:
        """Return a tip moved along the needle to where its end is seen and the stage has it.

        Parameters
        ----------
        tip : SpatialTip
            As believed of one pair.
        shaft : ndarray, shape (n, 3), or None
            Points along the whole shaft in `rig` [m], where the pair shows it.
        insertion : float or None
            Length of needle in the phantom [m].
        """
        ahead = tip.direction
        behind = self._shaft if shaft is None else shaft[:-1]
        behind = behind[(behind - tip.position) @ ahead < -_PITCH]
        if insertion is None or len(behind) < _LEAST_POINTS:
            return tip
        whole = np.vstack([behind, tip.position])
        seen = float(ahead @ tip.covariance @ ahead)
        now = _Offset(shaft_length(whole) - insertion, seen, insertion)
        if abs(now.value) > self._margin:
            return tip
        self._shaft = whole
        best = self._best
        if best is None or now.is_better_than(best):
            self._best = best = now
        variance = best.variance_at(insertion)
        # A zero that is plainly off is worth less.
        zero = max(self._zero_variance, (best.value / _PLAINLY) ** 2 - variance)
        offset = best.value * zero / (zero + variance)
        left = variance * zero / (zero + variance)
        beside = np.eye(3) - np.outer(ahead, ahead)
        return dataclasses.replace(
            tip,
            position=tip.position + (offset - now.value) * ahead,
            covariance=beside @ tip.covariance @ beside + left * np.outer(ahead, ahead),
        )


@dataclasses.dataclass(frozen=True)
class _Offset:
    """By how much a needle is seen longer than it was pushed in.

    Attributes
    ----------
    value : float
        That [m].
    variance : float
        Of the end along the needle [m^2].
    insertion : float
        At which it was seen [m].
    """

    value: float
    variance: float
    insertion: float

    def is_better_than(self, other: _Offset) -> bool:
        """Return whether this says more than one of another pair of the run."""
        before = other.variance_at(self.insertion)
        farther = self.value - other.value
        return self.variance <= before or farther > math.sqrt(self.variance + before)

    def variance_at(self, insertion: float) -> float:
        """Return the variance at another insertion [m^2]: the needle slips."""
        slipped = _SLIP * (insertion - self.insertion)
        return self.variance + slipped * slipped
