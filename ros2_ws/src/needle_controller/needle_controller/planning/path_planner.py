"""Plans a needle's path to a target round obstacles, anew at every step.

What is followed is the law for points (turn the bevel towards where the needle is to go) with the
path's next via point in the target's place. The plan of the step before is kept, from where the
needle is now, while its beginning is clear and no other is better by `_BETTER_BY`: a plan that
changes its mind with the noise of every tip turns the bevel for nothing.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.planning.clearance import assess
from needle_controller.planning.flood_fill import may_have_path
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_search import QUICK_STARTS, first_guess, improve
from needle_controller.planning.path_settings import PathSettings, Question, Unknown
from needle_core.settings.bounds import check_bounded_fields, check_bounds

_BETTER_BY = 0.004
"""Cost by which another path must be better than the one that is followed [m]."""
_ERODED = 0.5
"""Share of what must be clear beside the needle that may be lost just before it, on the way."""
_SHORTEST_REST = 0.0005
"""A leg of which less is left is done [m]."""


@dataclasses.dataclass(frozen=True)
class NeedlePath:
    """A path.

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
    scarce, broken, cost : float
        See `Assessment` [m].
    """

    legs: Array
    insertion: float
    length: float
    margin: float
    beginning: float
    scarce: float
    broken: float
    cost: float

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
        self._least_beginning = -_ERODED * settings.sigmas * settings.settled_std

    def path(
        self,
        tip: TipState,
        target: npt.ArrayLike,
        obstacles: Obstacles,
        *,
        insertion: float = 0.0,
        followed: NeedlePath | None = None,
        starts: int = QUICK_STARTS,
    ) -> NeedlePath | None:
        """Return the path to follow, None where none is found.

        Before insertion it keeps all that it must. On the way the best is followed even where it
        does not, while its beginning is clear: new tips may show that it does.

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
        starts : int
            How often the search is begun, at most.

        Raises
        ------
        UserError
            A curvature or insertion that is not finite or out of bounds.
        """
        question = self._question(tip, target, obstacles, insertion)
        path = self._best(question, insertion, followed, starts)
        if path is not None and path.broken <= 0.0:
            return path
        if followed is None:
            return None
        # All of the curvature: this is what the rest was held back for.
        question = question._replace(curvature=tip.curvature)
        return self._best(question, insertion, followed, starts)

    def _best(
        self, question: Question, insertion: float, followed: NeedlePath | None, starts: int
    ) -> NeedlePath | None:
        """Return the path that costs least, None where none is clear for its beginning."""
        rest = np.array([[*question.target, math.inf]])
        best = kept = _answer(rest, question, insertion)
        if followed is not None:
            rest = followed.rest(insertion)
            rest[-1, :3] = question.target
            kept = _answer(rest, question, insertion)
        for number in range(starts):
            if self._lacks_nothing(best) or self._lacks_nothing(kept):
                break
            if best.broken <= 0.0 and number >= QUICK_STARTS:
                break
            legs, draws = first_guess(question.start[:, 3], question.target, number)
            path = NeedlePath(legs, insertion, *improve(legs, question, draws))
            if path.cost < best.cost:
                best = path
        favour = 0.0 if followed is None else _BETTER_BY
        clear = [path for path in (kept, best) if path.beginning >= self._least_beginning]
        return min(clear, key=lambda path: path.cost - favour * (path is kept), default=None)

    def warm_up(self) -> None:
        """Run what questions run: compiled code is made here, not while a needle waits for it."""
        tip, target = TipState(np.zeros(3), np.eye(3), 1.0), np.array([0.0, 0.0, 0.01])
        question = self._question(tip, target, Obstacles(), 0.0)
        may_have_path(question)
        legs, draws = first_guess(tip.position, target, 0)
        improve(legs, question, draws[:1])

    def may_have_path(self, tip: TipState, target: npt.ArrayLike, obstacles: Obstacles) -> bool:
        """Return False where it is certain that no path exists, not even for a pose that is known.

        Parameters as of `path`.
        """
        return may_have_path(self._question(tip, target, obstacles, 0.0))

    def _question(
        self, tip: TipState, target: npt.ArrayLike, obstacles: Obstacles, insertion: float
    ) -> Question:
        check_bounds("curvature", tip.curvature, 0.1, 100.0, "1/m")
        settings = self.settings
        return Question(
            tip.pose,
            np.array(target, dtype=float),
            settings.curvature_share * tip.curvature,
            obstacles.table,
            tip.unknown,
            settings.longest - insertion,
            settings,
        )

    def _lacks_nothing(self, path: NeedlePath) -> bool:
        """Return whether nothing but a shorter path is better."""
        return path.margin >= self.settings.comfort and path.scarce <= 0.0


def _answer(legs: Array, question: Question, insertion: float) -> NeedlePath:
    return NeedlePath(legs, insertion, *assess(legs, question, 0.0))
