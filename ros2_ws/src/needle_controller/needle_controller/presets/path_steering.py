"""Steering to a point past obstacles: the law for points, led along a planned path."""

from __future__ import annotations

import math

import numpy as np

from needle_controller.laws.law import SteeringCommand
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import PITCH, YAW, X
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate
from needle_controller.planning.entry import entry_state, first_path
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.planning.path_planner import NeedlePath, PathPlanner, TipState
from needle_controller.planning.path_settings import PathSettings
from needle_controller.presets.point_steering import prompt_point_law
from needle_controller.presets.steering_settings import SteeringSettings


def path_planner(settings: SteeringSettings) -> PathPlanner:
    """Return the planner of a rig's needle."""
    return PathPlanner(
        PathSettings(
            max_rotation_per_length=settings.max_rotation_per_length, longest=settings.depth
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
    """Leads one needle past obstacles.

    Parameters
    ----------
    settings : SteeringSettings
        The rig's.

    Attributes
    ----------
    path : NeedlePath or None
        What is followed.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._planner = path_planner(settings)
        self._law = prompt_point_law(settings)
        self.path: NeedlePath | None = None

    def why_not(self, target: Array, obstacles: Obstacles, rotation: float) -> str:
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
        self.path, why = first_path(self._planner, entry, target, obstacles)
        return why

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
        tip = tip_state(estimate, plane)
        self.path = self._planner.path(
            tip, target, obstacles, insertion=insertion, followed=self.path
        )
        if self.path is None:
            return None
        command = self._law(estimate, plane.from_rig(self.path.aim))
        if len(self.path.legs) == 1:
            return command
        left = np.asarray(self.path.length)
        return SteeringCommand(command.virtual_input, command.rotation_rate, left)


def tip_state(estimate: Estimate, plane: TargetPlane) -> TipState:
    """Return the tip that an estimate in a plane's frame is of, in `rig`."""
    turn, covariance = plane.T_rig_plane[:3, :3], estimate.covariance
    across = max(covariance[X, X], covariance[X + 1, X + 1])
    return TipState(
        position=turn @ estimate.position + plane.T_rig_plane[:3, 3],
        rotation=turn @ estimate.rotation,
        curvature=float(estimate.curvature),
        position_std=math.sqrt(max(across, 0.0)),
        heading_std=math.sqrt(max(covariance[PITCH, PITCH], covariance[YAW, YAW], 0.0)),
    )
