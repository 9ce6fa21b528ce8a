"""One needle's estimator and law, from tips in `rig` to the rotation of the next step."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_controller.laws.law import Command
from needle_controller.model.arrays import Array
from needle_controller.model.kinematics import rotation_from_angles
from needle_controller.model.target_plane import TargetPlane
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.measured_pitch import measured_pitch
from needle_controller.observers.pitch_observer import PitchObserver
from needle_controller.presets.control_settings import ControlSettings
from needle_controller.presets.presets import make_controller
from needle_controller.protocol.joint_history import JointSample
from needle_controller.protocol.tip_covariance import TipCovariance

LARGEST_START_ROLL = np.deg2rad(80.0)
"""Of presets whose coordinates end at roll +-90 deg [rad]."""
_ONE_SIDED = ("paper", "open_loop")


@dataclasses.dataclass(frozen=True)
class ControlUpdate:
    """What one tip led to.

    Attributes
    ----------
    estimate : Estimate
        In `target_plane`.
    command : Command
        For the next step.
    turned : float
        Rotation of the base since the first tip [rad].
    """

    estimate: Estimate
    command: Command
    turned: float


class PlaneControl:
    """Estimator and law of one needle, in the target plane's coordinates.

    Parameters
    ----------
    settings : ControlSettings
        What estimator and law are made of.
    plane : TargetPlane
        The wanted plane.

    Raises
    ------
    UserError
        Weights that give no gains, or flips with a preset that cannot make them.
    """

    def __init__(self, settings: ControlSettings, plane: TargetPlane) -> None:
        self._settings = settings
        self._plane = plane
        self._estimator, self._law = make_controller(settings, plane.T_plane_rig[:3, :3])
        self._joints: JointSample | None = None
        self._first_joints: JointSample | None = None
        self._warm_up()

    @property
    def plane(self) -> TargetPlane:
        """The wanted plane; a new one carries the estimate over."""
        return self._plane

    @plane.setter
    def plane(self, plane: TargetPlane) -> None:
        self._estimator.change_frame(plane.T_plane_rig @ self._plane.T_rig_plane)
        self._plane = plane

    def configure(self, settings: ControlSettings) -> None:
        """Take new settings, keeping the estimated pose; raises UserError with nothing changed."""
        if self._joints is None:
            rotation = self._plane.T_plane_rig[:3, :3]
            self._estimator, self._law = make_controller(settings, rotation)
        else:
            # A new estimator that starts where the needle is now, its base turned as it is.
            now, joints = self._estimator.estimate(), self._joints
            unturned = rotation_from_angles([0.0, 0.0, -joints.rotation])
            self._estimator, self._law = make_controller(settings, now.rotation @ unturned)
            self._estimator.reset(now.position, [joints.insertion, joints.rotation])
        self._settings = settings

    def restart(self) -> None:
        """Forget the needle: the next tip is the first."""
        rotation = self._plane.T_plane_rig[:3, :3]
        self._estimator, self._law = make_controller(self._settings, rotation)
        self._joints = self._first_joints = None

    @property
    def started(self) -> bool:
        """Whether a first tip was taken since the last restart."""
        return self._joints is not None

    @property
    def largest_start_roll(self) -> float:
        """Largest roll in the plane that the preset can start at [rad]."""
        one_sided = self._settings.preset in _ONE_SIDED
        return float(LARGEST_START_ROLL) if one_sided else math.inf

    def start_roll(self, rotation: float) -> float:
        """Return the roll in the plane of a needle entering with its base at `rotation` [rad]."""
        start = self._plane.T_plane_rig[:3, :3] @ rotation_from_angles([0.0, 0.0, rotation])
        return float(np.arctan2(-start[0, 1], start[0, 0]))

    def update(
        self, tip: Array, joints: JointSample, known: TipCovariance | None = None
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
            # An encoder at rest may read a count less; drawing out is the protocol's business.
            inserted = max(joints.insertion - self._joints.insertion, 0.0)
            self._estimator.advance(inserted, joints.rotation - self._joints.rotation)
            self._correct(position, known)
        self._joints = joints
        estimate = self._estimator.estimate()
        turned = joints.rotation - self._first_joints.rotation
        return ControlUpdate(estimate, self._law(estimate, joints.insertion), turned)

    def _correct(self, position: Array, known: TipCovariance | None) -> None:
        estimator, settings = self._estimator, self._settings
        if known is None:
            estimator.correct(position, settings.tip_covariance())
            return
        turn = self._plane.T_plane_rig[:3, :3]
        covariance = turn @ known.matrix @ turn.T + np.eye(3) * settings.measurement_std**2
        if isinstance(estimator, PitchObserver):
            pitch = measured_pitch(known.direction, known.direction_covariance, turn)
            estimator.correct(position, covariance, pitch=pitch)
        else:
            estimator.correct(position, covariance)

    def _warm_up(self) -> None:
        """Run once what an update runs: compiled code is made here, not at the first tip."""
        estimator, law = make_controller(self._settings, np.eye(3))
        estimator.reset(np.zeros(3), np.zeros(2))
        estimator.advance(self._settings.step_length, 0.0)
        estimator.correct([0.0, 0.0, self._settings.step_length], self._settings.tip_covariance())
        estimate = estimator.estimate()
        law(estimate, self._settings.step_length)
        estimate.covariance  # noqa: B018 - lazy, and compiled too
