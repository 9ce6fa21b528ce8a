"""Planner of a needle's path to a target around obstacles, which replans at every step.

The needle follows the path by the law for points (turn the bevel towards the target), with the next
via point as the target. The previous plan is continued from the present pose while its beginning is
clear and no other plan is better by `_BETTER_BY`: a plan that changes with the noise of every tip
would turn the bevel unnecessarily.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.planning.flood_fill import may_have_path
from needle_controller.planning.legs import MOST_POINTS, leg_towards, trace_leg, truncated
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_evaluation import (
    PathEvaluation,
    PathProblem,
    PathSettings,
    PoseUncertainty,
    evaluate_path,
)
from needle_controller.planning.path_search import (
    QUICK_STARTS,
    THOROUGH_STARTS,
    initial_legs,
    optimize_legs,
)
from needle_core.settings.bounds import check_bounds

_BETTER_BY = 0.004
"""Least advantage in cost for which the previous path is abandoned [m]."""
_NEAR_SHARE = 0.5
"""Share of the tracking error's clearance that may be missing just ahead of the needle."""
_SHORTEST_LEG = 0.0005
"""Remaining length at which a leg is complete [m]."""
_ENTRY_OFFSETS = (0.001, 0.002, 0.004, 0.007, 0.011, 0.016)
"""Radii of the rings on which other entries are tried [m]."""
_ENTRIES_PER_RING = 8


@dataclasses.dataclass(frozen=True)
class NeedlePath:
    """A path.

    Attributes
    ----------
    legs : ndarray, shape (K, 4)
        Aim of each leg in `rig`, and its length [m]. The last aim is the target.
    insertion : float
        Insertion at the beginning of the path [m].
    curvature : float
        Largest curvature of the path [1/m].
    evaluation : PathEvaluation
        Its evaluation. A path with a violation is only followed if there is no other.
    """

    legs: Array
    insertion: float
    curvature: float
    evaluation: PathEvaluation

    @property
    def aim(self) -> Array:
        """Aim of the first leg, shape (3,) [m]."""
        return np.asarray(self.legs[0, :3])

    def remaining_legs(self, insertion: float) -> Array:
        """Return the remaining legs at an insertion [m]; at least the last one."""
        done = insertion - self.insertion
        first = int(np.searchsorted(np.cumsum(self.legs[:-1, 3]), done + _SHORTEST_LEG))
        left = self.legs[first:].copy()
        left[0, 3] -= done - float(np.sum(self.legs[:first, 3]))
        left[-1, 3] = math.inf
        return np.asarray(left)


@dataclasses.dataclass(frozen=True)
class TipState:
    """Pose of the tip at the beginning of a path.

    Attributes
    ----------
    position : ndarray, shape (3,)
        Position in `rig` [m].
    rotation : ndarray, shape (3, 3)
        Orientation in `rig`: the heading is the last column.
    curvature : float
        kappa [1/m].
    position_std, heading_std : float
        Standard deviations of the position across the needle [m], and of the heading [rad].
    """

    position: Array
    rotation: Array
    curvature: float
    position_std: float = 0.0
    heading_std: float = 0.0

    @property
    def pose(self) -> Array:
        """Pose for compiled code, shape (3, 4)."""
        return np.hstack([self.rotation, np.reshape(self.position, (3, 1))])


def entry_state(curvature: float, *, rotation: float = 0.0, heading_std: float = 0.0) -> TipState:
    """Return a needle's tip at the rig's entry point.

    Parameters
    ----------
    curvature : float
        kappa [1/m].
    rotation : float
        Rotation of the base [rad].
    heading_std : float
        Standard deviation of the heading [rad].
    """
    turned = rotation_from_angles([0.0, 0.0, rotation])
    return TipState(np.zeros(3), turned, curvature, heading_std=heading_std)


class PathPlanner:
    """Plans paths for one needle.

    Parameters
    ----------
    settings : PathSettings
        Requirements.

    Raises
    ------
    OutOfBoundsError
        A rotation rate that is too small for planning.
    """

    def __init__(self, settings: PathSettings) -> None:
        rate = settings.max_rotation_per_length
        check_bounds("max_rotation_per_length", rate, 1.0, 1e5, "rad/m")
        self.settings = settings
        self._least_near_margin = -_NEAR_SHARE * settings.sigmas * settings.tracking_std

    def path(
        self,
        tip: TipState,
        target: npt.ArrayLike,
        obstacles: Obstacles,
        *,
        insertion: float = 0.0,
        previous: NeedlePath | None = None,
        starts: int = QUICK_STARTS,
    ) -> NeedlePath | None:
        """Return the path to follow; None if none is found.

        A needle that is not yet inserted needs a path without violations. Later, the best path is
        followed even with a violation while its beginning is clear: new tips may show that the rest
        is clear, too.

        Parameters
        ----------
        tip : TipState
            Present tip.
        target : array_like, shape (3,)
            Target in `rig` [m].
        obstacles : Obstacles
            Obstacles to avoid.
        insertion : float
            Present insertion [m].
        previous : NeedlePath, optional
            Path followed so far.
        starts : int
            Largest number of starts of the search.

        Raises
        ------
        UserError
            A curvature or insertion that is not finite or out of bounds.
        """
        problem = self._problem(tip, target, obstacles, insertion)
        path = self._best(problem, insertion, previous, starts)
        if path is not None and path.evaluation.violation <= 0.0:
            return path
        if previous is None:
            return None
        # Use the whole curvature; a share of it was reserved for this case.
        problem = problem._replace(curvature=tip.curvature)
        return self._best(problem, insertion, previous, starts)

    def first_path(
        self, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
    ) -> NeedlePath | str:
        """Return the path of a needle that is not yet inserted, or the reason why there is none.

        If the quick search finds no path and the flood fill does not rule one out, the thorough
        search follows. The reason distinguishes a proof ("no path is clear") from a failed search
        ("was found clear"), and names a nearby entry with a path, if any.

        Parameters
        ----------
        entry : TipState
            The needle's tip.
        target : array_like, shape (3,)
            Target in `rig` [m].
        obstacles : Obstacles
            Obstacles to avoid.
        """
        path = self.path(entry, target, obstacles)
        if path is not None:
            return path
        clear = self.settings.least_clearance
        for name, point, minimum in (
            ("target point", target, clear - self.settings.goal_tolerance),
            ("entry", entry.position, clear),
        ):
            if (distance := obstacles.clearance(point)) < minimum:
                return f"the {name} is {distance:.4g} m from an obstacle, minimum {minimum:.4g} m"
        possible = self.may_have_path(entry, target, obstacles)
        path = self.path(entry, target, obstacles, starts=THOROUGH_STARTS) if possible else None
        if path is not None:
            return path
        is_clear = "was found clear" if possible else "is clear"
        reason = f"no path to the target point {is_clear} of the {len(obstacles)} obstacles"
        nearest = self.nearest_entry(entry, target, obstacles)
        if nearest is None:
            return f"{reason}, nor from any entry up to {_ENTRY_OFFSETS[-1]:.4g} m from it"
        x, y = nearest
        return f"{reason}; there is one from an entry at ({x:.4g}, {y:.4g}) m instead of (0, 0)"

    def nearest_entry(
        self, entry: TipState, target: npt.ArrayLike, obstacles: Obstacles
    ) -> Array | None:
        """Return the nearest entry (x, y) [m], on rings around a given one, with a path.

        The parameters are those of `first_path`. Heading and rotation stay the same.
        """
        for offset, k in itertools.product(_ENTRY_OFFSETS, range(_ENTRIES_PER_RING)):
            angle = 2.0 * math.pi * k / _ENTRIES_PER_RING
            moved = entry.position + offset * np.array([math.cos(angle), math.sin(angle), 0.0])
            if self.path(dataclasses.replace(entry, position=moved), target, obstacles) is not None:
                return np.asarray(moved[:2])
        return None

    def _best(
        self, problem: PathProblem, insertion: float, previous: NeedlePath | None, starts: int
    ) -> NeedlePath | None:
        """Return the path of least cost; None if no path has a clear beginning."""
        legs = np.array([[*problem.target, math.inf]])
        best = kept = _evaluated(legs, problem, insertion)
        if previous is not None:
            legs = previous.remaining_legs(insertion)
            legs[-1, :3] = problem.target
            kept = _evaluated(legs, problem, insertion)
        for number in range(starts):
            if self._is_satisfactory(best) or self._is_satisfactory(kept):
                break
            if best.evaluation.violation <= 0.0 and number >= QUICK_STARTS:
                break
            legs, draws = initial_legs(problem.start[:, 3], problem.target, number)
            evaluation = optimize_legs(legs, problem, draws)
            if evaluation.cost < best.evaluation.cost:
                best = NeedlePath(legs, insertion, problem.curvature, evaluation)
        bonus = 0.0 if previous is None else _BETTER_BY
        least = self._least_near_margin
        clear = [path for path in (kept, best) if path.evaluation.near_margin >= least]
        return min(
            clear, key=lambda path: path.evaluation.cost - bonus * (path is kept), default=None
        )

    def trace(self, path: NeedlePath, tip: TipState) -> Array:
        """Return the corners of a polyline along a path from a tip, shape (N, 3) [m]."""
        settings, pose, corners = self.settings, tip.pose, np.empty((MOST_POINTS, 4))
        share = settings.gentle_share / settings.curvature_share
        parts = []
        for row in path.legs:
            leg = leg_towards(pose, row, path.curvature, share, settings.max_rotation_per_length)
            count = trace_leg(pose, truncated(leg, row[3]), path.curvature, 0.0, corners, pose)
            parts.append(corners[:count, :3].copy())
        return np.concatenate(parts)

    def warm_up(self) -> None:
        """Compile the planning code, which would otherwise delay the first steps."""
        tip, target = TipState(np.zeros(3), np.eye(3), 1.0), np.array([0.0, 0.0, 0.01])
        problem = self._problem(tip, target, Obstacles(), 0.0)
        may_have_path(problem)
        legs, draws = initial_legs(tip.position, target, 0)
        optimize_legs(legs, problem, draws[:1])
        self.trace(_evaluated(legs, problem, 0.0), tip)

    def may_have_path(self, tip: TipState, target: npt.ArrayLike, obstacles: Obstacles) -> bool:
        """Return False if there is certainly no path, even for a known pose.

        The parameters are those of `path`.
        """
        return may_have_path(self._problem(tip, target, obstacles, 0.0))

    def _problem(
        self, tip: TipState, target: npt.ArrayLike, obstacles: Obstacles, insertion: float
    ) -> PathProblem:
        check_bounds("curvature", tip.curvature, 0.1, 100.0, "1/m")
        settings = self.settings
        return PathProblem(
            tip.pose,
            np.array(target, dtype=float),
            settings.curvature_share * tip.curvature,
            obstacles.table,
            PoseUncertainty(tip.position_std, tip.heading_std),
            settings.longest - insertion,
            settings,
        )

    def _is_satisfactory(self, path: NeedlePath) -> bool:
        """Return whether only a shorter path would be better."""
        found = path.evaluation
        return found.margin >= self.settings.preferred_margin and found.gentle_miss <= 0.0


def _evaluated(legs: Array, problem: PathProblem, insertion: float) -> NeedlePath:
    return NeedlePath(legs, insertion, problem.curvature, evaluate_path(legs, problem, 0.0))
