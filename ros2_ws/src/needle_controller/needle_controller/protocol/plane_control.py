"""Estimator and law of one needle: from measured tips in `rig` to the rotation of the next step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from needle_controller.filter.records import NEAR
from needle_controller.laws.law import SteeringCommand, StepLaw
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.model.reachability import least_insertion, least_insertion_to_point
from needle_controller.model.target_motion import TargetMotion
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate, Estimator
from needle_controller.planning.obstacles import Obstacles
from needle_controller.presets.path_steering import (
    PathSteering,
    Route,
    path_planner,
)
from needle_controller.presets.point_steering import PointSteering, point_law
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import ONE_SIDED_PRESETS, SteeringSettings
from needle_controller.protocol.confidence import point_miss_probability
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.tip_checks import TipCovariance

LARGEST_START_ROLL = math.radians(80.0)
"""Largest initial roll for presets whose coordinates are limited to roll +-90 deg [rad]."""
HEADING_CORRELATION = 0.01
"""Inserted length over which measured headings count as one, because errors of the sensor's
alignment and registration repeat [m]: harmless up to 10 mrad (60 needles each)."""
_FAR_AWAY = Obstacles(np.array([[0.5, 0.0, 0.01, 0.5, 0.0, 0.02, 0.001]]))


class Reachability(NamedTuple):
    """Whether plane or point can be reached, and the smallest insertion for that [m].

    NaN if a point can never be reached.
    """

    reachable: bool
    depth: float


@dataclasses.dataclass(frozen=True)
class ControlUpdate:
    """Result of one tip.

    Attributes
    ----------
    estimate : Estimate
        Estimate in `target_plane`.
    command : SteeringCommand
        Command for the next step.
    turned : float
        Rotation of the base since the first tip [rad].
    reach : Reachability
        Reachability of the plane, or the point.
    miss_probability : float, optional
        Probability that the tip is more than 1 mm from the plane, or from the expected position
        of the point; None if the estimator reports none.
    blocked : bool
        Whether no path is clear of the obstacles, so that there is no further step.
    route : Route, optional
        Planned route; None if no path is planned or clear.
    """

    estimate: Estimate
    command: SteeringCommand
    turned: float
    reach: Reachability
    miss_probability: float | None
    blocked: bool = False
    route: Route | None = None


class PlaneControl:
    """Estimator and law of one needle, in the coordinates of the target plane.

    If there is a target point, the needle is steered to the point, and the plane only provides
    the coordinates.

    Parameters
    ----------
    settings : SteeringSettings
        Settings of estimator and law, target plane or point, and obstacles.

    Attributes
    ----------
    obstacles : Obstacles
        Obstacles on the path to a point; they may change at any time.
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._plane = settings.plane()
        self._points: PointSteering | None = None
        self.target_point = _configured_point(settings)
        self.obstacles = Obstacles(np.reshape(settings.obstacles, (-1, 7)))
        self._path = PathSteering(settings)
        self._estimator, self._law = _new_controller(settings, self._plane)
        self._joints: JointSample | None = None
        self._first_joints: JointSample | None = None
        self._rotation = 0.0
        self._warm_up()

    @property
    def plane(self) -> TargetPlane:
        """The target plane; setting a new one transforms the estimate."""
        return self._plane

    @plane.setter
    def plane(self, plane: TargetPlane) -> None:
        self._estimator.change_frame(plane.T_plane_rig @ self._plane.T_rig_plane)
        self._plane = plane

    @property
    def target_point(self) -> Array | None:
        """Target point in `rig`, shape (3,) [m]; None to steer to the plane.

        A point that is set does not move; see `observe_target_point`.
        """
        return None if self._points is None else self._points.motion.last

    @target_point.setter
    def target_point(self, point: Array | None) -> None:
        self._points = None
        if point is not None:
            self.observe_target_point(point, 0.0)

    def observe_target_point(self, point: Array, time: float) -> None:
        """Add an observation of the target point, whose motion is predicted from all observations.

        Parameters
        ----------
        point : ndarray, shape (3,)
            Point in `rig` [m].
        time : float
            Time of the observation on the clock of the tips [s].
        """
        if self._points is None:
            self._points = PointSteering(self._settings, TargetMotion())
        self._points.motion.observe(time, point)

    def configure(self, settings: SteeringSettings) -> None:
        """Change the settings, and keep the estimated pose.

        Plane and point stay unless their own settings change; a preset that cannot steer to a
        point removes it.
        """
        if self._joints is None:
            self._estimator, self._law = _new_controller(settings, self._plane)
        else:
            # The new estimator starts at the present pose, with the present rotation of the base.
            now, joints = self._estimator.estimate(), self._joints
            unturned = rotation_from_angles([0.0, 0.0, -joints.rotation])
            self._estimator, self._law = make_controller(settings, now.rotation @ unturned)
            self._estimator.reset(now.position, [joints.insertion, joints.rotation])
        if settings.target_offset != self._settings.target_offset:
            self.plane = settings.plane()
        if settings.target_point != self._settings.target_point:
            self.target_point = _configured_point(settings)
        if not settings.steers_to_points:
            self.target_point = None
        if settings.obstacles != self._settings.obstacles:
            self.obstacles = Obstacles(np.reshape(settings.obstacles, (-1, 7)))
        self._path = PathSteering(settings)
        self._settings = settings
        self._restart_point_steering()

    def restart(self) -> None:
        """Discard the state of the needle: the next tip is the first."""
        self._estimator, self._law = _new_controller(self._settings, self._plane)
        self._joints = self._first_joints = None
        self._rotation = 0.0
        self._restart_point_steering()

    def _restart_point_steering(self) -> None:
        if self._points is not None:
            self._points = PointSteering(self._settings, self._points.motion)

    @property
    def started(self) -> bool:
        """Whether a tip was used since the last restart."""
        return self._joints is not None

    def roll_problem(self, rotation: float) -> str:
        """Return why a needle cannot enter with its base at `rotation` [rad]; empty if it can."""
        start = self._plane.T_plane_rig[:3, :3] @ rotation_from_angles([0.0, 0.0, rotation])
        roll = float(np.arctan2(-start[0, 1], start[0, 0]))
        if self._settings.preset not in ONE_SIDED_PRESETS or abs(roll) <= LARGEST_START_ROLL:
            return ""
        return (
            f"the needle's roll in target_plane is {roll:.3g} rad (rotation_joint "
            f"{rotation:.4g} rad), must be within {LARGEST_START_ROLL:.3g} rad"
        )

    def update(
        self,
        tip: npt.ArrayLike,
        joints: JointSample,
        covariance: TipCovariance | None = None,
        intermediate: Sequence[JointSample] = (),
    ) -> ControlUpdate:
        """Update the estimate with a tip, and compute the next command.

        Parameters
        ----------
        tip : array_like, shape (3,)
            The tip in `rig` [m].
        joints : JointSample
            Joint positions at its exposure.
        covariance : TipCovariance, optional
            Covariance of the tip in `rig`; the configured one by default. `measurement_std`
            squared is added, for errors that repeat from tip to tip and errors of the model: a
            filter that trusts micrometres would keep a wrong roll.
        intermediate : sequence of JointSample
            Joint positions since the last tip, where rotation was not proportional to insertion.

        Returns
        -------
        ControlUpdate
            Estimate and command.
        """
        position = self._plane.from_rig(tip)
        if self._joints is None or self._first_joints is None:
            self._first_joints = joints
            self._estimator.reset(position, np.array([joints.insertion, joints.rotation]))
        else:
            inserted = joints.insertion - self._joints.insertion
            for sample in (*intermediate, joints):
                self._advance(self._joints, sample)
                self._joints = sample
            self._correct(position, covariance, inserted)
        self._joints = joints
        estimate = self._estimator.estimate()
        command = self._command(estimate, joints)
        return ControlUpdate(
            estimate=estimate,
            command=command or SteeringCommand(0.0, 0.0),
            turned=joints.rotation - self._first_joints.rotation,
            reach=self._reach(estimate, joints),
            miss_probability=self._miss_probability(estimate),
            blocked=command is None,
            route=None if self._points is None or not self._is_planned else self._path.last_route,
        )

    def _advance(self, before: JointSample, joints: JointSample) -> None:
        # An encoder at rest may read one count less; the protocol handles retraction.
        inserted = max(joints.insertion - before.insertion, 0.0)
        rotation = joints.rotation - before.rotation
        self._rotation += abs(rotation)
        self._estimator.advance(inserted, rotation)

    def _correct(self, position: Array, covariance: TipCovariance | None, inserted: float) -> None:
        settings = self._settings
        if covariance is None:
            self._estimator.correct(position, settings.configured_covariance())
            return
        turn = self._plane.T_plane_rig[:3, :3]
        correct_heading = getattr(self._estimator, "correct_heading", None)
        if covariance.heading is not None and correct_heading is not None:
            direction, variance = covariance.heading
            repeats = max(1.0, HEADING_CORRELATION / max(inserted, 1e-5))
            correct_heading(turn @ direction, repeats * variance)
        matrix = turn @ covariance.matrix @ turn.T + np.eye(3) * settings.measurement_std**2
        self._estimator.correct(position, matrix)

    def path_problem(self, rotation: float) -> str:
        """Return why a needle before insertion has no path to its point; empty if it has one.

        Parameters
        ----------
        rotation : float
            Rotation of the base [rad].
        """
        if self.target_point is None or not self._is_planned:
            return ""
        return self._path.find_first(self.target_point, self.obstacles, rotation)

    def _command(self, estimate: Estimate, joints: JointSample) -> SteeringCommand | None:
        if self._points is None:
            return self._law(estimate, joints.insertion)
        if self._is_planned:
            point = self._points.motion.last
            return self._path.command(
                estimate, self._plane, point, self.obstacles, joints.insertion
            )
        return self._points.command(
            estimate,
            joints.stamp_ns * 1e-9,
            joints.insertion,
            self._settings.rotation_budget - self._rotation,
            self._plane.from_rig,
        )

    @property
    def _is_planned(self) -> bool:
        """Whether a path is planned: with obstacles, and always with another package's planner."""
        return len(self.obstacles) > 0 or self._settings.planner != ""

    def _reach(self, estimate: Estimate, joints: JointSample) -> Reachability:
        curvature, end = estimate.curvature, self._settings.depth
        if self._points is None:
            needed = least_insertion(estimate.reduced, curvature, tolerance=NEAR)
        else:
            offset = self._plane.from_rig(self._points.aim) - estimate.position
            ahead = estimate.rotation.T @ offset
            needed = least_insertion_to_point(ahead, curvature, tolerance=NEAR)
            end += NEAR
        depth = joints.insertion + float(needed)
        return Reachability(depth <= end, depth)

    def _miss_probability(self, estimate: Estimate) -> float | None:
        if self._points is None or estimate.miss is None:
            return estimate.miss
        offset = estimate.position - self._plane.from_rig(self._points.aim)
        return float(point_miss_probability(offset, estimate.covariance[:3, :3]))

    def _warm_up(self) -> None:
        """Compile the code of updates, which would otherwise delay the first steps."""
        settings, length = self._settings, self._settings.step_length
        estimator, law = make_controller(settings, np.eye(3))
        position = np.zeros(3)
        estimator.reset(position, np.zeros(2))
        estimator.advance(length, 0.0)
        estimator.correct(position, settings.configured_covariance())
        estimate = estimator.estimate()
        law(estimate, length)
        if settings.steers_to_points:
            point_law(settings)(estimate, [0.0, 0.0, 1.0])
            end = np.array([0.0, 0.0, settings.depth])
            PathSteering(settings).command(estimate, self._plane, end, _FAR_AWAY, length)
            path_planner(settings).warm_up()


def _new_controller(settings: SteeringSettings, plane: TargetPlane) -> tuple[Estimator, StepLaw]:
    """Return estimator and law of a needle before insertion, at the origin of `rig` along z."""
    return make_controller(settings, plane.T_plane_rig[:3, :3], plane.from_rig(np.zeros(3)))


def _configured_point(settings: SteeringSettings) -> Array | None:
    return np.array(settings.target_point) if settings.target_point else None
