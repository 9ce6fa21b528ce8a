"""Prediction of the tip: a Kalman filter over the insertion for its position and heading.

The state is the tip p and its heading h, a unit vector; the needle goes its heading's way, which
bends by at most the largest curvature: p' = p + s h, h' = h + (random across h, up to kappa s),
with s the insertion in between. It goes as far as the stage pushes it: what is off along h changes
p, not the length of h.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from needle_tracker.tracking.triangulation import SpatialTip

Array = NDArray[np.float64]

_DRIFT = 0.02e-3  # what moves from pair to pair at rest [m]
_LEAN_SIGMA = 0.12  # between the visible end and the heading (pre-bend) [rad]
# What spoils a view spoils the next one's too: the gain is not all believed.
_ALIKE = 1.0
_NO_SURPRISE = 6.0  # squared, over its covariance
_ON_WAY, _MOVED = 9.0, 9.0  # likewise, across the way and along it
_APART = 0.25  # variance of what lies between two places, over their squared distance


@dataclasses.dataclass(frozen=True)
class TipMotion:
    """Position and heading with their covariance.

    Attributes
    ----------
    position : ndarray, shape (3,)
        In `rig` [m].
    heading : ndarray, shape (3,)
        Unit vector.
    covariance : ndarray, shape (6, 6)
        Of both [m^2, m, -].
    """

    position: Array
    heading: Array
    covariance: Array

    @classmethod
    def start(cls, tip: SpatialTip) -> TipMotion:
        """Return the state after a first tip: the heading is that of the visible end, loosely."""
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = tip.covariance
        covariance[3:, 3:] = _LEAN_SIGMA**2 * across(tip.direction)
        return cls(tip.position, tip.direction, covariance)

    def advanced(self, ahead: float, curvature: float, unseen: float = 0.0) -> TipMotion:
        """Return the state farther along the insertion.

        Parameters
        ----------
        ahead : float
            How far; negative where the needle is drawn back [m].
        curvature : float
            The largest [1/m].
        unseen : float
            How far the needle went before without being seen by both views [m]: it may have bent
            the same way all along.
        """
        transition = np.eye(6)
        transition[:3, 3:] = ahead * np.eye(3)
        way = abs(ahead)
        turned = curvature * math.sqrt(way * (way + 2.0 * unseen))
        noise = np.zeros((6, 6))
        noise[:3, :3] = (_DRIFT**2 + (0.5 * turned * ahead) ** 2) * np.eye(3)
        noise[3:, 3:] = turned**2 * across(self.heading)
        return TipMotion(
            self.position + ahead * self.heading,
            self.heading,
            transition @ self.covariance @ transition.T + noise,
        )

    @property
    def sigma(self) -> float:
        """Largest standard deviation of the position in any direction [m]."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    def surprise(self, tip: SpatialTip) -> float:
        """Return the squared distance of a measured tip, over the covariance of both."""
        off = tip.position - self.position
        return float(off @ np.linalg.solve(self.covariance[:3, :3] + tip.covariance, off))

    def gone_to(self, tip: SpatialTip, curvature: float) -> float | None:
        """Return how far a needle that was here has gone along its axis to a measured tip.

        Parameters
        ----------
        tip : SpatialTip
            As measured.
        curvature : float
            The largest [1/m].

        Returns
        -------
        float or None
            Squared, over the covariance of both along the axis; None for a tip beside its way.
        """
        way = float((tip.position - self.position) @ self.heading)
        if self.advanced(way, curvature).surprise(tip) > _ON_WAY:
            return None
        along = self.heading @ (self.covariance[:3, :3] + tip.covariance) @ self.heading
        return way * way / float(along)

    def direction_surprise(self, tip: SpatialTip) -> float:
        """Return the squared angle of a tip's direction to the heading, over all that is unknown.

        That is the covariance of both and what the visible end may lean; infinite backwards.
        """
        if float(tip.direction @ self.heading) <= 0.0:
            return math.inf
        plane = across(self.heading)
        unknown = self.covariance[3:, 3:] + tip.direction_covariance + _LEAN_SIGMA**2 * np.eye(3)
        off = plane @ tip.direction
        return float(off @ np.linalg.pinv(plane @ unknown @ plane, hermitian=True) @ off)

    def merged(self, tip: SpatialTip) -> SpatialTip:
        """Return a measured tip merged with this state."""
        motion = self.updated(tip)
        return dataclasses.replace(
            tip, position=motion.position, covariance=motion.covariance[:3, :3].copy()
        )

    def updated(self, tip: SpatialTip) -> TipMotion:
        """Return the state with a measured tip taken in."""
        return self.taken_in(tip.position - self.position, np.eye(3), tip.covariance)

    def taken_in(self, off: Array, slope: Array, covariance: Array) -> TipMotion:
        """Return the state with a measurement that depends on the position taken in.

        Parameters
        ----------
        off : ndarray, shape (n,)
            Measured less expected.
        slope : ndarray, shape (n, 3)
            Of the measurement over the position.
        covariance : ndarray, shape (n, n)
            Of the measurement.
        """
        both = slope @ self.covariance[:3, :3] @ slope.T + covariance
        gain = self.covariance[:, :3] @ slope.T @ np.linalg.inv(both)
        change = gain @ off
        left = self.covariance - gain @ slope @ self.covariance[:3, :]
        # K (1 - K): most where prediction and measurement count alike.
        share = gain[:3] @ slope
        left[:3, :3] += _ALIKE * (np.eye(3) - share) @ share @ left[:3, :3]
        # What shifts an end along the needle (bevel, blur, light) shifts the next one as far: along
        # it nothing averages out.
        along = self.heading
        k = min(max(float(along @ share @ along), 0.0), 1.0)
        same = 2.0 * math.sqrt(k * (1.0 - k)) * float(along @ left[:3, :3] @ along)
        left[:3, :3] += same * np.outer(along, along)
        # A surprise says that one of the two is wrong, not which.
        surprise = float(off @ np.linalg.solve(both, off))
        if surprise > _NO_SURPRISE:
            apart = np.linalg.pinv(slope) @ off
            left[:3, :3] += _APART * (1.0 - _NO_SURPRISE / surprise) * np.outer(apart, apart)
        heading = self.heading + change[3:]
        return TipMotion(
            self.position + change[:3],
            heading / np.linalg.norm(heading),
            0.5 * (left + left.T),
        )


@dataclasses.dataclass(frozen=True)
class Anchor:
    """The last believed tip, or where it should be now.

    Attributes
    ----------
    motion : TipMotion
        Position and heading.
    insertion : float or None
        Of that moment [m].
    ahead : float
        How far this is ahead of what was seen last [m].
    known : bool
        Whether that follows from the insertion.
    unseen : float
        How far the needle went since both views showed it [m].
    """

    motion: TipMotion
    insertion: float | None
    ahead: float = 0.0
    known: bool = False
    unseen: float = 0.0

    def is_about(self, tip: SpatialTip, miss: float, surprise: float, turned: float) -> bool:
        """Return whether a tip is where and points as the insertion says, to so much.

        Parameters
        ----------
        tip : SpatialTip
            As measured.
        miss : float
            Distance that it is nearer than [m].
        surprise, turned : float
            Square of how far it is off in place and direction, over its covariance, less than which
            it is.
        """
        if not self.known or self.motion.direction_surprise(tip) > turned:
            return False
        off = float(np.linalg.norm(tip.position - self.motion.position))
        return off < miss and self.motion.surprise(tip) < surprise


@dataclasses.dataclass(frozen=True)
class Sights:
    """Sights in a row of what may be a needle.

    Attributes
    ----------
    begin : TipMotion or None
        Where it was seen first; None where a needle was believed last.
    last : Anchor
        Where it was seen last.
    count : int
        Pairs.
    """

    begin: TipMotion | None
    last: Anchor
    count: int = 1

    def one_more(self, seen: Anchor) -> Sights:
        """Return these and another."""
        return Sights(self.begin, seen, self.count + 1)

    def lead_to(self, tip: SpatialTip, curvature: float) -> bool:
        """Return whether a tip is where it stood or has gone to along its axis."""
        return self.begin is None or self.begin.gone_to(tip, curvature) is not None

    def has_moved(self, tip: SpatialTip, curvature: float) -> bool:
        """Return whether it has gone to a tip since it was seen first; what was believed has."""
        return self.begin is None or (self.begin.gone_to(tip, curvature) or 0.0) > _MOVED


def across(unit: Array) -> Array:
    """Return the projection onto the plane across a unit vector, (3, 3)."""
    return np.eye(3) - np.outer(unit, unit)


_END_PITCH = 0.5e-3
"""Insertion per end that is kept [m]."""
_SHOULD_HAVE_MOVED = 3e-3
"""Insertion after which a needle's end must have moved [m]."""
_STILL = 0.25
"""An end that moved by less than this share of the insertion stayed still."""
_OFTEN = 2
"""Earlier sightings that show it: a glint may move a needle's end by its face, up to 2 mm."""


class SeenEnds:
    """Places of an end, by insertion."""

    def __init__(self) -> None:
        self._ends: dict[int, tuple[float, Array]] = {}

    def add(self, position: Array, insertion: float) -> None:
        """Note an end at `position` in `rig` [m], seen at an insertion [m]."""
        self._ends[round(insertion / _END_PITCH)] = insertion, position

    def is_still(self, position: Array, insertion: float) -> bool:
        """Return whether an end at `position` [m] did not move with the needle.

        Parameters
        ----------
        position : ndarray, shape (3,)
            The end in `rig` [m].
        insertion : float
            Of the needle now [m].
        """
        moved = [(abs(insertion - at), position - end) for at, end in self._ends.values()]
        long = [(way, off) for way, off in moved if way >= _SHOULD_HAVE_MOVED]
        return sum(float(np.linalg.norm(off)) < _STILL * way for way, off in long) >= _OFTEN
