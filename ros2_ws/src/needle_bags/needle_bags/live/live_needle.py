"""The needle as it is known now: what was seen, what is believed, what is wanted."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_bags.run.shaft_trail import ShaftTrail
from needle_controller.model.target_plane import TargetPlane, offset_plane

Array = NDArray[np.float64]

# A plane that was asked for is the one in force if its offset is [m].
_SAME_OFFSET = 1e-6


@dataclasses.dataclass(frozen=True)
class SeenTip:
    """A tip that the tracker found.

    Attributes
    ----------
    stamp_ns : int
        Time of exposure [ns].
    place : ndarray, shape (3,)
        In `rig` [m].
    quaternion : ndarray, shape (4,)
        x, y, z, w of the frame whose z axis is the shaft.
    covariance : ndarray, shape (3, 3)
        Of the place [m^2].
    """

    stamp_ns: int
    place: Array
    quaternion: Array
    covariance: Array


@dataclasses.dataclass(frozen=True)
class Belief:
    """The controller's estimate, in `target_plane`.

    Attributes
    ----------
    place : ndarray, shape (3,)
        Of the tip [m].
    rotation : ndarray, shape (3, 3)
        Axes of the tip's frame as columns; the third is the heading.
    covariance : ndarray, shape (3, 3)
        Of the place [m^2].
    """

    place: Array
    rotation: Array
    covariance: Array


class LiveNeedle:
    """Gathers what the graph says, and answers what there is to be drawn.

    Attributes
    ----------
    tip : SeenTip or None
        The last that was found.
    answered_ns : int or None
        Exposure of the last answer, found or not [ns].
    is_seen : bool
        Whether a tip was found in that.
    target_point : ndarray, shape (3,), or None
        The point that is steered to, in `rig` [m].
    """

    def __init__(self) -> None:
        self.tip: SeenTip | None = None
        self.answered_ns: int | None = None
        self.is_seen = False
        self.target_point: Array | None = None
        self._belief: Belief | None = None
        self._asked_plane: TargetPlane | None = None
        self._offset: float | None = None
        self._insertion = 0.0
        self._trail = ShaftTrail()

    def take_insertion(self, insertion: float) -> None:
        """Take how far the needle is in [m]."""
        self._insertion = insertion

    def take_tip(self, tip: SeenTip) -> None:
        """Take a tip that was found."""
        self.tip, self.answered_ns, self.is_seen = tip, tip.stamp_ns, True
        self._trail.add(self._insertion, tip.place)

    def take_no_tip(self, stamp_ns: int) -> None:
        """Take that none was found in an exposure [ns]."""
        self.answered_ns, self.is_seen = stamp_ns, False

    def take_belief(self, belief: Belief) -> None:
        """Take what the controller believes."""
        self._belief = belief

    def take_plane(self, plane: TargetPlane) -> None:
        """Take a plane that was asked for."""
        self._asked_plane = plane

    def take_targets(self, offset: float | None, point: Array | None) -> None:
        """Take what is in force: the plane's offset [m], and the point where one is steered to."""
        self._offset, self.target_point = offset, point

    @property
    def plane(self) -> TargetPlane | None:
        """The wanted plane; None before the controller has spoken."""
        if self._offset is None:
            return None
        asked = self._asked_plane
        if asked is not None and abs(asked.offset - self._offset) <= _SAME_OFFSET:
            return asked
        return offset_plane(self._offset)

    @property
    def belief(self) -> Belief | None:
        """The controller's estimate, in `rig`; None while there is none."""
        plane, belief = self.plane, self._belief
        if plane is None or belief is None:
            return None
        rotation, origin = plane.T_rig_plane[:3, :3], plane.T_rig_plane[:3, 3]
        return Belief(
            place=rotation @ belief.place + origin,
            rotation=rotation @ belief.rotation,
            covariance=rotation @ belief.covariance @ rotation.T,
        )

    @property
    def path(self) -> Array:
        """Way of the tip in `rig` [m], shape (n, 3)."""
        return self._trail.path

    @property
    def shaft(self) -> Array | None:
        """Shaft in `rig`, from the entry to the tip [m], shape (n, 3); None without a tip."""
        return None if self.tip is None else self._trail.shaft(self._insertion, self.tip.place)
