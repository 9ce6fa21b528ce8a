"""One needle's estimator and law, from tips in `rig` to the rotation of the next step."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from needle_controller.filter.bank import MERGE_EVERY
from needle_controller.filter.records import NEAR
from needle_controller.laws.law import SteeringCommand, StepLaw
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.model.point_reach import point_reachability
from needle_controller.model.reachability import Reachability, reachability
from needle_controller.model.target_motion import TargetMotion
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate, Estimator
from needle_controller.planning.obstacles import Obstacle, Obstacles
from needle_controller.presets.path_steering import PathSteering, configured_obstacles, path_planner
from needle_controller.presets.point_steering import PointSteering, point_law
from needle_controller.presets.presets import make_controller
from needle_controller.presets.steering_settings import ONE_SIDED_PRESETS, SteeringSettings
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.tip_gate import TipCovariance
from needle_controller.protocol.trust import point_missed

LARGEST_START_ROLL = np.deg2rad(80.0)
"""Of presets whose coordinates end at roll +-90 deg [rad]."""
_FAR_AWAY = Obstacles([Obstacle((0.5, 0.0, 0.01), (0.5, 0.0, 0.02), 0.001)])


@dataclasses.dataclass(frozen=True)
class ControlUpdate:
    """Result of one tip.

    Attributes
    ----------
    estimate : Estimate
        In `target_plane`.
    command : SteeringCommand
        For the next step.
    turned : float
        Rotation of the base since the first tip [rad].
    reach : Reachability
        Of the plane, or the point.
    missed : float, optional
        Probability that the tip is more than 1 mm from the plane, or from where the point is
        expected; None where the estimator does not say.
    blocked : bool
        Whether no way on is clear of the obstacles: no further step then.
    """

    estimate: Estimate
    command: SteeringCommand
    turned: float
    reach: Reachability
    missed: float | None
    blocked: bool = False


class PlaneControl:
    """Estimator and law of one needle, in the target plane's coordinates.

    While there is a target point the needle is steered to that, and the plane's frame is no more
    than coordinates.

    Parameters
    ----------
    settings : SteeringSettings
        What estimator and law are made of.
    plane : TargetPlane
        The wanted plane.

    Attributes
    ----------
    obstacles : Obstacles
        What it must not touch on its way to a point; it may change at any time.
    """

    def __init__(self, settings: SteeringSettings, plane: TargetPlane) -> None:
        self._settings = settings
        self._plane = plane
        self._points: PointSteering | None = None
        self.target_point = _point(settings)
        self.obstacles = configured_obstacles(settings)
        self._path = PathSteering(settings)
        self._estimator, self._law = _new_controller(settings, plane)
        self._joints: JointSample | None = None
        self._first_joints: JointSample | None = None
        self._rotation = 0.0
        self._warm_up()

    @property
    def plane(self) -> TargetPlane:
        """The wanted plane; a new one carries the estimate over."""
        return self._plane

    @plane.setter
    def plane(self, plane: TargetPlane) -> None:
        self._estimator.change_frame(plane.T_plane_rig @ self._plane.T_rig_plane)
        self._plane = plane

    @property
    def target_point(self) -> Array | None:
        """Point that the tip is to reach, in `rig`, shape (3,) [m]; None: the plane.

        What is set rests there; see `see_target_point`.
        """
        return None if self._points is None else self._points.motion.last

    @target_point.setter
    def target_point(self, point: Array | None) -> None:
        self._points = None
        if point is not None:
            self.see_target_point(point, 0.0)

    def see_target_point(self, point: Array, time: float) -> None:
        """Take where the target is at a time of the tips' clock; what moves is foretold.

        Parameters
        ----------
        point : ndarray, shape (3,)
            In `rig` [m].
        time : float
            When it was there [s].
        """
        if self._points is None:
            self._points = PointSteering(self._settings, TargetMotion())
        self._points.motion.see(time, point)

    def configure(self, settings: SteeringSettings) -> None:
        """Take new settings; the estimated pose stays, plane and point unless their own change.

        A preset that cannot steer to a point ends it.
        """
        if self._joints is None:
            self._estimator, self._law = _new_controller(settings, self._plane)
        else:
            # A new estimator that starts where the needle is now, its base turned as it is.
            now, joints = self._estimator.estimate(), self._joints
            unturned = rotation_from_angles([0.0, 0.0, -joints.rotation])
            self._estimator, self._law = make_controller(settings, now.rotation @ unturned)
            self._estimator.reset(now.position, [joints.insertion, joints.rotation])
        if settings.target_offset != self._settings.target_offset:
            self.plane = settings.plane()
        if settings.target_point != self._settings.target_point:
            self.target_point = _point(settings)
        if not settings.steers_to_points:
            self.target_point = None
        if settings.obstacles != self._settings.obstacles:
            self.obstacles = configured_obstacles(settings)
        self._path = PathSteering(settings)
        self._settings = settings
        if self._points is not None:
            self._points = PointSteering(settings, self._points.motion)

    def restart(self) -> None:
        """Forget the needle: the next tip is the first."""
        self._estimator, self._law = _new_controller(self._settings, self._plane)
        self._joints = self._first_joints = None
        self._rotation = 0.0
        if self._points is not None:
            self._points = PointSteering(self._settings, self._points.motion)

    @property
    def started(self) -> bool:
        """Whether a first tip was taken since the last restart."""
        return self._joints is not None

    @property
    def largest_start_roll(self) -> float:
        """Largest roll in the plane that the preset can start at [rad]."""
        one_sided = self._settings.preset in ONE_SIDED_PRESETS
        return float(LARGEST_START_ROLL) if one_sided else math.inf

    def start_roll(self, rotation: float) -> float:
        """Return the roll in the plane of a needle entering with its base at `rotation` [rad]."""
        start = self._plane.T_plane_rig[:3, :3] @ rotation_from_angles([0.0, 0.0, rotation])
        return float(np.arctan2(-start[0, 1], start[0, 0]))

    def update(
        self,
        tip: Array,
        joints: JointSample,
        known: TipCovariance | None = None,
        way: Sequence[JointSample] = (),
    ) -> ControlUpdate:
        """Take a tip.

        Parameters
        ----------
        tip : ndarray, shape (3,)
            The tip in `rig` [m].
        joints : JointSample
            The joints at its exposure.
        known : TipCovariance, optional
            How well the tip is known, in `rig`; as configured if none is given. `measurement_std`
            squared is added: no source knows what repeats from tip to tip, nor what the needle's
            model leaves out, and a filter that believes in micrometres holds on to the wrong roll.
        way : sequence of JointSample
            Joints on the way since the last tip, where rotation was not in proportion to insertion.

        Returns
        -------
        ControlUpdate
            The estimate and what to do next.
        """
        position = self._plane.from_rig(tip)
        if self._joints is None or self._first_joints is None:
            self._first_joints = joints
            self._estimator.reset(position, np.array([joints.insertion, joints.rotation]))
        else:
            for sample in (*way, joints):
                self._advance(sample)
            self._correct(position, known)
        self._joints = joints
        estimate = self._estimator.estimate()
        turned = joints.rotation - self._first_joints.rotation
        command = self._command(estimate, joints)
        reach, missed = self._reach(estimate, joints), self._missed(estimate)
        if command is None:
            still = SteeringCommand(0.0, 0.0)
            return ControlUpdate(estimate, still, turned, reach, missed, blocked=True)
        return ControlUpdate(estimate, command, turned, reach, missed)

    def _advance(self, joints: JointSample) -> None:
        assert self._joints is not None
        # An encoder at rest may read a count less; drawing out is the protocol's business.
        inserted = max(joints.insertion - self._joints.insertion, 0.0)
        rotation = joints.rotation - self._joints.rotation
        self._rotation += abs(rotation)
        self._estimator.advance(inserted, rotation)
        self._joints = joints

    def path_obstacle(self, rotation: float) -> str:
        """Return why no path leads a needle that is out to its point, empty if one does.

        Parameters
        ----------
        rotation : float
            Of the base [rad].
        """
        if self.target_point is None or not self._is_planned:
            return ""
        return self._path.why_not(self.target_point, self.obstacles, rotation)

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
        """Whether a planner leads to the point: ours past obstacles, an own one always."""
        return len(self.obstacles) > 0 or self._settings.planner != ""

    def _reach(self, estimate: Estimate, joints: JointSample) -> Reachability:
        limits = {
            "insertion": joints.insertion,
            "end": self._settings.depth,
            "tolerance": NEAR,
        }
        if self._points is None:
            return reachability(estimate.reduced, estimate.curvature, **limits)
        offset = self._plane.from_rig(self._points.aim) - estimate.position
        return point_reachability(estimate.rotation.T @ offset, estimate.curvature, **limits)

    def _missed(self, estimate: Estimate) -> float | None:
        if self._points is None or estimate.miss is None:
            return estimate.miss
        off = estimate.position - self._plane.from_rig(self._points.aim)
        return float(point_missed(off, estimate.covariance[:3, :3]))

    def _correct(self, position: Array, known: TipCovariance | None) -> None:
        estimator, settings = self._estimator, self._settings
        if known is None:
            estimator.correct(position, settings.configured_covariance())
            return
        turn = self._plane.T_plane_rig[:3, :3]
        covariance = turn @ known.matrix @ turn.T + np.eye(3) * settings.measurement_std**2
        estimator.correct(position, covariance)

    def _warm_up(self) -> None:
        """Run what updates run: compiled code is made here, not while a needle waits for it."""
        settings, length = self._settings, self._settings.step_length
        estimator, law = make_controller(settings, np.eye(3))
        estimator.reset(np.zeros(3), np.zeros(2))
        for tips in range(1, MERGE_EVERY + 1):
            estimator.advance(length, 0.0)
            estimator.correct([0.0, 0.0, tips * length], settings.configured_covariance())
        estimate = estimator.estimate()
        law(estimate, length)
        if settings.steers_to_points:
            point_law(settings)(estimate, [0.0, 0.0, 1.0])
            ahead = np.array([0.0, 0.0, 0.5 * settings.depth])
            PathSteering(settings).command(estimate, self._plane, ahead, _FAR_AWAY, length)
            path_planner(settings).warm_up()


def _new_controller(settings: SteeringSettings, plane: TargetPlane) -> tuple[Estimator, StepLaw]:
    """Return estimator and law of a needle that is out, along z of `rig` at its origin."""
    return make_controller(settings, plane.T_plane_rig[:3, :3], plane.from_rig(np.zeros(3)))


def _point(settings: SteeringSettings) -> Array | None:
    return np.array(settings.target_point) if settings.target_point else None
