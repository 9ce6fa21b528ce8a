"""A plan of flips: insertion depths at which the bevel is turned to the other side of the plane.

Within the plane, the needle bends to the side given by the sign of cos(roll). Turning the bevel
over at planned depths makes it follow a path of arcs (Reed et al., Integrated planning and
image-guided control for planar needle steering, BioRob 2008), while the law keeps it in the plane.
"""

from __future__ import annotations

import dataclasses

from needle_core.errors import OutOfBoundsError, UserError


@dataclasses.dataclass(frozen=True)
class FlipPlan:
    """Insertion depths at which the bevel is flipped.

    Attributes
    ----------
    depths : tuple of float
        Depths in increasing order, above 0 [m]; none by default.

    Raises
    ------
    UserError
        Depths that are not above 0 or not increasing.
    """

    depths: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Check the depths."""
        before = 0.0
        for number, depth in enumerate(self.depths, start=1):
            if depth <= before:
                bound = f"> {before:g} m" + (", the flip before it" if number > 1 else "")
                raise UserError(f"flip {number} at {depth:g} m, expected {bound}")
            before = depth

    def check_within(self, depth: float) -> None:
        """Check that every flip comes before the end of steering.

        Parameters
        ----------
        depth : float
            Insertion at which steering ends [m].

        Raises
        ------
        OutOfBoundsError
            A flip at that depth or beyond.
        """
        if self.depths and not self.depths[-1] < depth:
            number = len(self.depths)
            raise OutOfBoundsError(f"flip {number}", self.depths[-1], 0.0, depth, "m")

    def bend_sign(self, insertion: float) -> float:
        """Return the desired sign of cos(roll), +1 or -1, at an insertion; 0 without flips.

        Parameters
        ----------
        insertion : float
            Insertion depth [m]; at the depth of a flip, within 1 um, the sign is that after the
            flip.
        """
        if not self.depths:
            return 0.0
        done = sum(depth <= insertion + DEPTH_TOLERANCE for depth in self.depths)
        return 1.0 if done % 2 == 0 else -1.0


DEPTH_TOLERANCE = 1e-6
