"""One needle's estimator and law, from tips in `rig` to the rotation of the next step."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from needle_controller.arrays import Array
from needle_controller.estimator import Estimate
from needle_controller.gains import Gains, design_gains
from needle_controller.joint_history import JointSample
from needle_controller.kinematics import rotation_from_angles
from needle_controller.law import Command, Law, LinearizingLaw, OpenLoopLaw
from needle_controller.luenberger import LuenbergerObserver, LuenbergerSettings
from needle_controller.target_plane import TargetPlane

PRESETS = ("paper", "open_loop")
LARGEST_START_ROLL = np.deg2rad(80.0)


@dataclasses.dataclass(frozen=True)
class ControlSettings:
    """What estimator and law are made of; the node's parameters describe them and their units.

    The values here are the defaults, of the node and of studies alike.
    """

    preset: str = "paper"
    curvature: float = 1.0 / 0.122
    step_length: float = 0.001
    max_rotation_per_length: float = math.radians(30.0) / 0.001
    state_weights: tuple[float, ...] = (1.0e6, 280.0, 0.0)
    input_weight: float = 2.9e-10
    process_noise: tuple[float, ...] = (5.0e-7, 0.13, 24.0)
    measurement_std: float = 0.001 / math.sqrt(3.0)
    saturation_margin: float = 0.11
    demand_margin: float = 0.26
    initial_yaw_std: float = math.radians(10.0)
    initial_pitch_std: float = math.radians(10.0)
    initial_roll_std: float = math.radians(30.0)

    def gains(self) -> Gains:
        """Return the gains the weights give; raises UserError as `gains.design_gains` does."""
        return design_gains(
            state_weights=np.diag(self.state_weights),
            input_weight=self.input_weight,
            process_noise=np.diag(self.process_noise),
            measurement_std=self.measurement_std,
            step_length=self.step_length,
        )


def make_law(settings: ControlSettings, gains: Gains) -> Law:
    """Return the preset's law."""
    if settings.preset == "open_loop":
        return OpenLoopLaw()
    return LinearizingLaw(
        feedback=gains.feedback,
        step_length=settings.step_length,
        demand_margin=settings.demand_margin,
        max_rotation_per_length=settings.max_rotation_per_length,
    )


def observer_settings(settings: ControlSettings, gains: Gains) -> LuenbergerSettings:
    """Return what the preset's observer assumes."""
    return LuenbergerSettings(
        curvature=settings.curvature,
        observer_poles=gains.observer_poles,
        process_noise=np.diag(settings.process_noise),
        measurement_std=settings.measurement_std,
        saturation_margin=settings.saturation_margin,
        initial_yaw_std=settings.initial_yaw_std,
        initial_pitch_std=settings.initial_pitch_std,
        initial_roll_std=settings.initial_roll_std,
    )


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
        Weights that give no gains.
    """

    def __init__(self, settings: ControlSettings, plane: TargetPlane) -> None:
        gains = settings.gains()
        self._plane = plane
        self._law = make_law(settings, gains)
        self._observer = LuenbergerObserver(
            observer_settings(settings, gains), plane.T_plane_rig[:3, :3]
        )
        self._joints: JointSample | None = None
        self._first_joints: JointSample | None = None

    @property
    def plane(self) -> TargetPlane:
        """The wanted plane; a new one carries the estimate over."""
        return self._plane

    @plane.setter
    def plane(self, plane: TargetPlane) -> None:
        self._observer.change_frame(plane.T_plane_rig @ self._plane.T_rig_plane)
        self._plane = plane

    def configure(self, settings: ControlSettings) -> None:
        """Take new settings, keeping the estimated pose; raises UserError with nothing changed."""
        gains = settings.gains()
        self._law = make_law(settings, gains)
        self._observer.settings = observer_settings(settings, gains)

    def restart(self) -> None:
        """Forget the needle: the next tip is the first."""
        self._joints = self._first_joints = None

    @property
    def started(self) -> bool:
        """Whether a first tip was taken since the last restart."""
        return self._joints is not None

    def start_roll(self, rotation: float) -> float:
        """Return the roll in the plane of a needle entering with its base at `rotation` [rad]."""
        start = self._plane.T_plane_rig[:3, :3] @ rotation_from_angles([0.0, 0.0, rotation])
        return float(np.arctan2(-start[0, 1], start[0, 0]))

    def update(self, tip: Array, joints: JointSample) -> ControlUpdate:
        """Take a tip.

        Parameters
        ----------
        tip : ndarray, shape (3,)
            The tip in `rig` [m].
        joints : JointSample
            The joints at its exposure.

        Returns
        -------
        ControlUpdate
            The estimate and what to do next.
        """
        position = self._plane.from_rig(tip)
        if self._joints is None or self._first_joints is None:
            self._first_joints = joints
            self._observer.reset(position, np.array([joints.insertion, joints.rotation]))
        else:
            # An encoder at rest may read a count less; drawing out is the protocol's business.
            inserted = max(joints.insertion - self._joints.insertion, 0.0)
            self._observer.advance(inserted, joints.rotation - self._joints.rotation)
            self._observer.correct(position)
        self._joints = joints
        estimate = self._observer.estimate()
        turned = joints.rotation - self._first_joints.rotation
        return ControlUpdate(estimate, self._law(estimate), turned)
