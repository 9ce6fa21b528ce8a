"""Plans a needle's path to a target round obstacles, anew at every step.

What is followed is the law for points (turn the bevel towards where the needle is to go) with the
path's next via point in the target's place. The plan of the step before is kept, from where the
needle is now, while it is clear and no other is better by `better_by`: a plan that changes its mind
with the noise of every tip turns the bevel for nothing.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.clearance import assess
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_search import MOST_VIA_POINTS, search
from needle_controller.planning.path_settings import PathSettings, Unknown
from needle_controller.planning.via_points import candidate_points
from needle_core.settings.bounds import check_bounded_fields, check_bounds

_STREWN = 1000
"""Points that a search grows its tree to beside those around the obstacles."""
_BETTER_BY = 0.004
"""Cost by which another path must be better than the one that is followed [m]."""
_PRICE_OF_DANGER, _PRICE_OF_MISS = 30.0, 5.0
"""Length that a path may be longer for each length that it lacks of what it must be clear by, and
that it passes the target by."""
_ERODED = 0.5
"""Share of what must be clear beside the needle that may be lost just before it, on the way."""
_SHORTEST_REST = 0.0005
"""A leg of which less is left is done [m]."""


@dataclasses.dataclass(frozen=True)
class NeedlePath:
    """A path that is clear.

    Attributes
    ----------
    legs : ndarray, shape (K, 4)
        Of each leg what the needle is steered towards, in `rig`, and the leg's length [m]. The
        last leads to the target.
    insertion : float
        At its beginning [m].
    length : float
        Of the whole [m].
    margin : float
        By what it is clearer than it must be, at the worst place [m]; inf without obstacles.
        Below 0 where it is followed all the same, for want of another.
    beginning : float
        The same of its first `committed_length`, for a pose that is known [m].
    miss : float
        Distance by which it passes the target [m].
    scarce : float
        The same for `curvature_share` of the curvature [m].
    """

    legs: Array
    insertion: float
    length: float
    margin: float
    beginning: float
    miss: float
    scarce: float

    @property
    def aim(self) -> Array:
        """Point that the needle is steered towards first, shape (3,) [m]."""
        return np.asarray(self.legs[0, :3])

    def rest(self, insertion: float) -> Array:
        """Return the legs that are left at an insertion [m], the last one always."""
        done = insertion - self.insertion
        first = int(np.searchsorted(np.cumsum(self.legs[:-1, 3]), done + _SHORTEST_REST))
        left = self.legs[first:].copy()
        left[0, 3] -= done - float(np.sum(self.legs[:first, 3]))
        left[-1, 3] = math.inf
        return np.asarray(left)


@dataclasses.dataclass(frozen=True)
class TipState:
    """A tip that paths begin at.

    Attributes
    ----------
    position : ndarray, shape (3,)
        In `rig` [m].
    rotation : ndarray, shape (3, 3)
        Its orientation in `rig`: the heading is the last column.
    curvature : float
        kappa [1/m].
    position_std, heading_std : float
        How well it is known, across the needle [m], [rad].
    """

    position: Array
    rotation: Array
    curvature: float
    position_std: float = 0.0
    heading_std: float = 0.0

    @property
    def pose(self) -> Array:
        """The pose as compiled code takes it, shape (3, 4)."""
        return np.hstack([self.rotation, np.reshape(self.position, (3, 1))])

    @property
    def unknown(self) -> Unknown:
        """Uncertainty of the start, as compiled code takes it."""
        return Unknown(self.position_std, self.heading_std)


@dataclasses.dataclass(frozen=True)
class _Question:
    """Arguments with which a path is asked for; see `PathPlanner.path`."""

    tip: TipState
    target: Array
    obstacles: Obstacles
    insertion: float


class PathPlanner:
    """Plans paths for one needle.

    Parameters
    ----------
    settings : PathSettings
        What must be clear, and what a path costs.

    Raises
    ------
    OutOfBoundsError
        A setting that is outside its bounds.
    """

    def __init__(self, settings: PathSettings) -> None:
        check_bounded_fields(settings)
        self.settings = settings

    def path(
        self,
        tip: TipState,
        target: npt.ArrayLike,
        obstacles: Obstacles,
        *,
        insertion: float = 0.0,
        followed: NeedlePath | None = None,
    ) -> NeedlePath | None:
        """Return the path to follow, None where none is clear.

        Parameters
        ----------
        tip : TipState
            Where the needle is.
        target : array_like, shape (3,)
            Where it is to go, in `rig` [m].
        obstacles : Obstacles
            What it must not touch.
        insertion : float
            Present insertion [m].
        followed : NeedlePath, optional
            What was followed up to now.

        Raises
        ------
        UserError
            A curvature or insertion that is not finite or out of bounds.
        """
        check_bounds("curvature", tip.curvature, 0.1, 100.0, "1/m")
        goal = np.array(target, dtype=float)
        question = _Question(tip, goal, obstacles, insertion)
        kept = None if followed is None else self._kept(question, followed)
        if kept is not None and kept.margin >= self.settings.comfort and kept.scarce <= 0.0:
            # Nothing but a shorter way is better.
            found: NeedlePath | None = self._straight(question)
        else:
            found = self._found(question, on_the_way=followed is not None)
        if kept is None:
            return found
        if found is None or self._cost(found) > self._cost(kept) - _BETTER_BY:
            return kept
        return found

    def _straight(self, question: _Question) -> NeedlePath | None:
        path = self._along(question, straight_to(question.target))
        return path if path.margin >= 0.0 and path.scarce <= 0.0 else None

    def _kept(self, question: _Question, followed: NeedlePath) -> NeedlePath | None:
        """Return what is left of the path followed, None where it comes too near to an obstacle."""
        rest = followed.rest(question.insertion)
        rest[-1, :3] = question.target
        path, settings = self._along(question, rest), self.settings
        return path if path.beginning >= -_ERODED * settings.sigmas * settings.settled_std else None

    def _along(self, question: _Question, legs: Array) -> NeedlePath:
        tip = question.tip
        length, margin, beginning, miss, scarce = assess(
            tip.pose,
            legs,
            tip.curvature,
            question.obstacles.table,
            tip.unknown,
            self.settings,
        )
        return NeedlePath(legs, question.insertion, length, margin, beginning, miss, scarce)

    def _found(self, question: _Question, *, on_the_way: bool) -> NeedlePath | None:
        """Return the best path of some searches, None where there is none.

        Where a path with little curvature is not comfortable, one with more may be. A needle on its
        way without a path takes one that is clear by what it will know by then.
        """
        settings, tip = self.settings, question.tip
        scarce = settings._replace(curvature_share=settings.largest_curvature_share)
        found = self._searched(question, tip.unknown, settings)
        if found is not None and found.margin >= settings.comfort:
            return found
        paths = [found, self._searched(question, tip.unknown, scarce)]
        if on_the_way and paths == [None, None]:
            paths = [self._searched(question, Unknown(0.0, 0.0), scarce)]
        clear = [path for path in paths if path is not None]
        return min(clear, key=self._cost) if clear else None

    def _searched(
        self, question: _Question, unknown: Unknown, settings: PathSettings
    ) -> NeedlePath | None:
        tip, table = question.tip, question.obstacles.table
        clear = settings.needle_radius + settings.sigmas * settings.settled_std
        distances = clear + np.array([0.0002, settings.comfort, 3.0 * settings.comfort])
        position = np.array(tip.position, dtype=float)
        candidates = candidate_points(position, question.target, table, distances, _STREWN)
        legs = np.full((MOST_VIA_POINTS + 1, 4), math.inf)
        count = search(
            tip.pose,
            question.target,
            tip.curvature,
            table,
            candidates,
            unknown,
            settings,
            settings.longest - question.insertion,
            legs,
        )
        if count < 0:
            return None
        legs[count, :3] = question.target
        legs[count, 3] = math.inf
        return self._along(question, legs[: count + 1].copy())

    def _cost(self, path: NeedlePath) -> float:
        settings = self.settings
        lacking = max(settings.comfort - path.margin, 0.0)
        return (
            path.length
            + settings.comfort_price * lacking
            + _PRICE_OF_DANGER * max(-path.margin, 0.0)
            + _PRICE_OF_MISS * path.scarce
        )


def straight_to(target: Array) -> Array:
    """Return the legs of the way to a target without via points, shape (1, 4) [m]."""
    return np.array([[*target, math.inf]])
