"""Steering to a point along a planned path, by the built-in planner or that of another package."""

from __future__ import annotations

import dataclasses
import math
from functools import cache

import numpy as np

from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import PITCH, YAW, X
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate
from needle_controller.planning.obstacles import Obstacles
from needle_controller.planning.path_evaluation import PathSettings
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState, entry_state
from needle_controller.presets.own_parts import OwnPart, own_part
from needle_controller.presets.point_steering import point_law
from needle_controller.presets.steering_settings import SteeringSettings

_VIA_POINTS = "via points x, y, z in rig [m], the target last"
_TARGET_TOLERANCE = 1e-6


@dataclasses.dataclass(frozen=True)
class Route:
    """Beginning of a planned path.

    Attributes
    ----------
    aim : ndarray, shape (3,)
        Point in `rig` towards which the needle is steered first [m].
    length : float or None
        Length of the whole path [m]; None if `aim` is the target.
    points : ndarray, shape (N, 3)
        Corners of a polyline along the path in `rig`, from the tip to its end [m].
    """

    aim: Array
    length: float | None
    points: Array


class OwnPlanner:
    """A planner of another package, whose via points are checked at every step.

    Parameters
    ----------
    part : OwnPart
        The planner.
    settings : SteeringSettings
        Settings of the controller.
    """

    def __init__(self, part: OwnPart, settings: SteeringSettings) -> None:
        self.part = part
        self._planner = part.make(settings)

    def route(self, tip: TipState, target: Array, obstacles: Obstacles) -> Route | None:
        """Return the route from a tip to a target; None if the planner finds none.

        Raises
        ------
        OwnPartError
            An exception of the planner, or points that are invalid or do not end at the target.
        """
        part = self.part
        arguments = tip, target.copy(), obstacles.table.copy()
        result = part.call("via_points", self._planner.via_points, *arguments)
        if result is None:
            return None
        count = len(result) if np.ndim(result) == 2 else 1
        points = part.checked("via_points()", result, (count, 3), _VIA_POINTS)
        if count < 1 or float(np.linalg.norm(points[-1] - target)) > _TARGET_TOLERANCE:
            raise part.error(f"via_points() does not end at the target {target.tolist()} m")
        corners = np.vstack([tip.position, points])
        if count == 1:
            return Route(target, None, corners)
        legs = np.diff(corners, axis=0)
        return Route(points[0], float(np.sum(np.linalg.norm(legs, axis=1))), corners)


@cache
def checked_planner(name: str) -> OwnPart:
    """Return the class of a planner of another package, after a trial with a straight path.

    Raises
    ------
    OwnPartError
        As for `own_part`; also if the planner raises, or returns an invalid route.
    """
    part = own_part("planner", name)
    settings = SteeringSettings()
    tip = entry_state(settings.curvature)
    OwnPlanner(part, settings).route(tip, np.array([0.0, 0.0, 0.08]), Obstacles([]))
    return part


def path_planner(settings: SteeringSettings) -> PathPlanner:
    """Return the planner for a rig's needle."""
    return PathPlanner(
        PathSettings(
            max_rotation_per_length=settings.max_rotation_per_length,
            needle_radius=0.5 * settings.needle_diameter,
            goal_tolerance=settings.goal_tolerance,
            longest=settings.depth,
        )
    )


class PathSteering:
    """Steers one needle around obstacles.

    Parameters
    ----------
    settings : SteeringSettings
        Settings of the rig.

    Attributes
    ----------
    path : NeedlePath or None
        Present path; None with another package's planner, which replans at every step.
    last_route : Route or None
        Route of the last command; None if no path was clear.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._planner = path_planner(settings)
        name = settings.planner
        self._own = OwnPlanner(checked_planner(name), settings) if name else None
        self._law = point_law(settings, is_prompt=True)
        self.path: NeedlePath | None = None
        self.last_route: Route | None = None

    def find_first(self, target: Array, obstacles: Obstacles, rotation: float) -> str:
        """Find the first path before insertion; return why there is none, empty if found.

        Parameters
        ----------
        target : ndarray, shape (3,)
            Target in `rig` [m].
        obstacles : Obstacles
            Obstacles to avoid.
        rotation : float
            Rotation of the base [rad].
        """
        settings = self._settings
        entry = entry_state(
            settings.curvature, rotation=rotation, heading_std=settings.entry_angle_std
        )
        if self._own is not None:
            if self._own.route(entry, target, obstacles) is not None:
                return ""
            return (
                f"planner {self._own.part.name} finds no path to the target point past "
                f"{len(obstacles)} obstacles"
            )
        found = self._planner.first_path(entry, target, obstacles)
        self.path = None if isinstance(found, str) else found
        return found if isinstance(found, str) else ""

    def command(
        self,
        estimate: Estimate,
        plane: TargetPlane,
        target: Array,
        obstacles: Obstacles,
        insertion: float,
    ) -> SteeringCommand | None:
        """Return the command for the next step; None if no path is clear.

        Parameters
        ----------
        estimate : Estimate
            Estimate in `plane`.
        plane : TargetPlane
            Frame of the estimate.
        target : ndarray, shape (3,)
            Target in `rig` [m].
        obstacles : Obstacles
            Obstacles to avoid.
        insertion : float
            Present insertion [m].
        """
        route = self.last_route = self._route(
            tip_state(estimate, plane), target, obstacles, insertion
        )
        if route is None:
            return None
        command = self._law(estimate, plane.from_rig(route.aim))
        if route.length is None:
            return command
        return SteeringCommand(command.virtual_input, command.rotation_rate, route.length)

    def _route(
        self, tip: TipState, target: Array, obstacles: Obstacles, insertion: float
    ) -> Route | None:
        if self._own is not None:
            return self._own.route(tip, target, obstacles)
        path = self.path = self._planner.path(
            tip, target, obstacles, insertion=insertion, previous=self.path
        )
        if path is None:
            return None
        length = None if len(path.legs) == 1 else path.evaluation.length
        return Route(path.aim, length, self._planner.trace(path, tip))


def tip_state(estimate: Estimate, plane: TargetPlane) -> TipState:
    """Transform the tip of an estimate from a plane's frame to `rig`."""
    turn, shift = plane.T_rig_plane[:3, :3], plane.T_rig_plane[:3, 3]
    variance = np.maximum(np.diagonal(estimate.covariance), 0.0)
    across, heading = max(variance[X], variance[X + 1]), max(variance[PITCH], variance[YAW])
    return TipState(
        turn @ estimate.position + shift,
        turn @ estimate.rotation,
        estimate.curvature,
        math.sqrt(across),
        math.sqrt(heading),
    )
