"""Presets beside `best` and `paper`: the other estimators, each with the law that suits it.

For comparison, in the node and in studies alike; docs/estimators.md says what each is good for.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.laws.bend_side_law import TwoSidedLinearizingLaw
from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.laws.law import Command, LinearizingLaw, StepLaw
from needle_controller.laws.roll_law import RollLaw
from needle_controller.observers.estimator import Estimate, Estimator
from needle_controller.observers.extended_kalman import ExtendedKalmanFilter, ExtendedKalmanSettings
from needle_controller.observers.linear_observer import LinearObserver, LinearObserverSettings
from needle_controller.observers.orientation_fit import OrientationFit, OrientationFitSettings
from needle_controller.observers.pitch_observer import PitchObserver, PitchObserverSettings
from needle_controller.presets.control_settings import ControlSettings
from needle_controller.presets.roll_steering import roll_law_settings, with_flips

_CURVATURES = 15
"""Tried by the orientation fit."""


def make_other_controller(
    settings: ControlSettings,
    law: LinearizingLaw,
    plan: FlipPlan,
    initial_rotation: npt.ArrayLike,
) -> tuple[Estimator, StepLaw]:
    """Return estimator and law of one of `control_settings.OTHER_PRESETS`.

    Parameters
    ----------
    settings : ControlSettings
        The preset and its numbers.
    law : LinearizingLaw
        (7) and (10), for `kalman` and `measured_pitch`.
    plan : FlipPlan
        Where the bevel is flipped.
    initial_rotation : array_like, shape (3, 3)
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`.
    """
    if settings.preset in {"kalman", "measured_pitch"}:
        return _on_linear_system(settings, law, plan, initial_rotation)
    estimator: Estimator
    if settings.preset == "extended_kalman":
        estimator = ExtendedKalmanFilter(
            ExtendedKalmanSettings(
                curvature=settings.curvature,
                measurement_std=settings.measurement_std,
                initial_roll_std=settings.initial_roll_std,
            ),
            initial_rotation,
        )
    else:
        estimator = OrientationFit(
            OrientationFitSettings(
                curvature=settings.curvature,
                measurement_std=settings.measurement_std,
                initial_roll_std=settings.initial_roll_std,
                entry_std=settings.measurement_std,
                curvatures=_CURVATURES,
            ),
            initial_rotation,
        )
    return estimator, with_flips(RollLaw(roll_law_settings(settings)), plan)


def _on_linear_system(
    settings: ControlSettings,
    law: LinearizingLaw,
    plan: FlipPlan,
    initial_rotation: npt.ArrayLike,
) -> tuple[Estimator, StepLaw]:
    linear = LinearObserverSettings(
        curvature=settings.curvature,
        process_noise=np.diag(settings.process_noise),
        measurement_std=settings.measurement_std,
        initial_pitch_std=settings.initial_pitch_std,
        initial_roll_std=settings.initial_roll_std,
        initial_yaw_std=settings.initial_yaw_std,
        saturation_margin=settings.saturation_margin,
    )
    observer = (
        LinearObserver(linear, initial_rotation)
        if settings.preset == "kalman"
        else PitchObserver(PitchObserverSettings(linear), initial_rotation)
    )
    two_sided = TwoSidedLinearizingLaw(law)

    def steer(estimate: Estimate, insertion: float) -> Command:
        sign = plan.bend_sign(insertion) if plan.depths else 0.0
        observer.flip_to(sign)
        return two_sided(estimate, sign)

    return observer, steer
