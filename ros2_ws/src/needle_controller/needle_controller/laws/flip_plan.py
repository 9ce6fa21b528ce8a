"""Flips: insertion depths at which the bevel is turned to the other side of the plane.

Within the plane, the needle bends to the side given by the sign of cos(roll). Turning the bevel
over at planned depths makes it follow a path of arcs (Reed et al., Integrated planning and
image-guided control for planar needle steering, BioRob 2008), while the law keeps it in the plane.
"""

from __future__ import annotations

from collections.abc import Sequence

from needle_core.errors import OutOfBoundsError, UserError

DEPTH_TOLERANCE = 1e-6


def check_flips(depths: Sequence[float], end: float) -> None:
    """Check that flips come in increasing order, above 0 and before the end of steering.

    Parameters
    ----------
    depths : sequence of float
        Insertion depths of the flips [m].
    end : float
        Insertion at which steering ends [m].

    Raises
    ------
    UserError
        Depths that are not above 0 or not increasing, or a flip at the end or beyond.
    """
    before = 0.0
    for number, depth in enumerate(depths, start=1):
        if depth <= before:
            bound = f"> {before:g} m" + (", the flip before it" if number > 1 else "")
            raise UserError(f"flip {number} at {depth:g} m, expected {bound}")
        before = depth
    if depths and not before < end:
        raise OutOfBoundsError(f"flip {len(depths)}", before, 0.0, end, "m")


def bend_sign(depths: Sequence[float], insertion: float) -> float:
    """Return the desired sign of cos(roll), +1 or -1, at an insertion; 0 without flips.

    Parameters
    ----------
    depths : sequence of float
        Insertion depths of the flips [m].
    insertion : float
        Insertion depth [m]; at the depth of a flip, within 1 um, the sign is that after the flip.
    """
    if not depths:
        return 0.0
    done = sum(depth <= insertion + DEPTH_TOLERANCE for depth in depths)
    return 1.0 if done % 2 == 0 else -1.0
