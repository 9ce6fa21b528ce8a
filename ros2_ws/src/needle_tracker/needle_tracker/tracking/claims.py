"""How well a look can know the needle's end, beyond what the fit of one pair says.

A line ends where its darkness ends: where a ground face looks like the floor, both images end short
by as much, and where light falls on one side of the needle, the line lies to the other in both. A
map knows more of faces, and less of where the needle's middle is. No residual tells. What can be
lost in that way is a share of the needle's width.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_tracker.optics.refraction import RefractedCamera
from needle_tracker.tracking.triangulation import SpatialTip


@dataclasses.dataclass(frozen=True)
class Unseen:
    """Standard deviations of what no fit tells, as seen in path-traced pairs.

    Attributes
    ----------
    along : float
        Along the shaft [needle widths].
    across : float
        Across it in an image [needle widths].
    """

    along: float
    across: float


OF_OUTLINE = Unseen(0.2, 0.01)
"""Of a line that stands out as a whole."""
OF_LAMP = Unseen(1.0, 0.1)
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
    """

    def __init__(
        self,
        views: tuple[RefractedCamera, RefractedCamera],
        needle_widths_px: tuple[float, float],
        needle_width: float,
    ) -> None:
        self._views = views
        self._needle_widths_px = needle_widths_px
        self._needle_width = needle_width

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
        claimed += np.outer(ahead, ahead) * (unseen.along * self._needle_width) ** 2
        return dataclasses.replace(tip, covariance=tip.covariance + claimed)
