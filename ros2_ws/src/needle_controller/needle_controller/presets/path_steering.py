"""Steering to a point past obstacles: the law for points, led along a planned path."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import PITCH, YAW, X
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate
from needle_controller.planning.entry import NoPath, entry_state, first_path
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState
from needle_controller.planning.path_settings import PathSettings
from needle_controller.presets.own_planner import OwnPlanner, Route, tried_planner
from needle_controller.presets.point_steering import prompt_point_law
from needle_controller.presets.steering_settings import SteeringSettings


def path_planner(settings: SteeringSettings) -> PathPlanner:
    """Return the planner of a rig's needle."""
    return PathPlanner(
        PathSettings(
            max_rotation_per_length=settings.max_rotation_per_length,
            needle_radius=0.5 * settings.needle_diameter,
            goal_tolerance=settings.goal_tolerance,
            longest=settings.depth,
        )
    )


def configured_obstacles(settings: SteeringSettings) -> Obstacles:
    """Return the obstacles of the settings; raises UserError as `Obstacles` does."""
    rows = np.reshape(settings.obstacles, (-1, 7))
    return Obstacles(
        [
            Obstacle(
                (float(row[0]), float(row[1]), float(row[2])),
                (float(row[3]), float(row[4]), float(row[5])),
                float(row[6]),
            )
            for row in rows
        ]
    )


class PathSteering:
    """Leads one needle past obstacles, by our planner or that of another package.

    Parameters
    ----------
    settings : SteeringSettings
        The rig's.

    Attributes
    ----------
    path : NeedlePath or None
        What is followed; None by another package's planner, which plans every step anew.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._planner = path_planner(settings)
        self._own = None
        if settings.planner:
            self._own = OwnPlanner(tried_planner(settings.planner), settings)
        self._law = prompt_point_law(settings)
        self.path: NeedlePath | None = None

    def find_first(self, target: Array, obstacles: Obstacles, rotation: float) -> str:
        """Return why a needle that is out cannot be led to a target, empty if it can.

        The path that is found is the first to be followed.

        Parameters
        ----------
        target : ndarray, shape (3,)
            In `rig` [m].
        obstacles : Obstacles
            What it must not touch.
        rotation : float
            Of the base [rad].
        """
        settings = self._settings
        entry = entry_state(
            settings.curvature, rotation=rotation, heading_std=settings.entry_angle_std
        )
        if self._own is not None:
            route = self._own.route(entry, target, obstacles)
            return "" if route is not None else self._own.why_not(obstacles)
        found = first_path(self._planner, entry, target, obstacles)
        self.path = None if isinstance(found, NoPath) else found
        return found.why if isinstance(found, NoPath) else ""

    def command(
        self,
        estimate: Estimate,
        plane: TargetPlane,
        target: Array,
        obstacles: Obstacles,
        insertion: float,
    ) -> SteeringCommand | None:
        """Return the command for the next step, None where no way on is clear.

        Parameters
        ----------
        estimate : Estimate
            In `plane`.
        plane : TargetPlane
            Its frame.
        target : ndarray, shape (3,)
            In `rig` [m].
        obstacles : Obstacles
            What the needle must not touch.
        insertion : float
            That the estimate is of [m].
        """
        route = self.route(tip_state(estimate, plane), target, obstacles, insertion)
        if route is None:
            return None
        command = self._law(estimate, plane.from_rig(route.aim))
        if route.length is None:
            return command
        return SteeringCommand(command.virtual_input, command.rotation_rate, route.length)

    def route(
        self, tip: TipState, target: Array, obstacles: Obstacles, insertion: float
    ) -> Route | None:
        """Return the way to go on from a tip, None where none is clear; see `command`."""
        if self._own is not None:
            return self._own.route(tip, target, obstacles)
        path = self.path = self._planner.path(
            tip, target, obstacles, insertion=insertion, followed=self.path
        )
        if path is None:
            return None
        return Route(path.aim, None if len(path.legs) == 1 else path.length)


def tip_state(estimate: Estimate, plane: TargetPlane) -> TipState:
    """Return the tip that an estimate in a plane's frame is of, in `rig`."""
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
