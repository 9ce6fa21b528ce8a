"""Controllers of a rig: an estimator and a law for each preset."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.filter.filter_settings import BOUNDED_NOISE, NORMAL_NOISE, FilterSettings
from needle_controller.filter.hypothesis_filter import HypothesisFilter
from needle_controller.laws.law import LinearizingGains, LinearizingLaw, OpenLoopLaw, StepLaw
from needle_controller.laws.roll_law import RollLaw, RollLawSettings, bend_sign
from needle_controller.observers.estimator import Estimator
from needle_controller.observers.luenberger import LuenbergerObserver, ObserverSettings
from needle_controller.presets.own_controllers import (
    OwnEstimator,
    OwnLaw,
    checked_estimator,
    checked_law,
)
from needle_controller.presets.steering_settings import SteeringSettings


def make_law(settings: SteeringSettings) -> LinearizingLaw | OpenLoopLaw:
    """Return the law of preset `paper`, (7) and (10), or that of `open_loop`."""
    if settings.preset == "open_loop":
        return OpenLoopLaw()
    return LinearizingLaw(
        LinearizingGains(
            feedback=settings.gains().feedback,
            step_length=settings.step_length,
            demand_margin=settings.demand_margin,
            max_rotation_per_length=settings.max_rotation_per_length,
        )
    )


def filter_settings(settings: SteeringSettings) -> FilterSettings:
    """Return the filter settings of preset `best`."""
    is_bounded = settings.tip_covariance == "configured" and settings.tip_noise == "bounded"
    return FilterSettings(
        curvature=settings.curvature,
        tip_noise_bound=settings.tip_noise_bound,
        noise_hypotheses=BOUNDED_NOISE if is_bounded else NORMAL_NOISE,
        initial_angle_std=settings.entry_angle_std,
    )


def observer_settings(settings: SteeringSettings) -> ObserverSettings:
    """Return the observer settings of presets `paper` and `open_loop`."""
    return ObserverSettings(
        curvature=settings.curvature,
        saturation_margin=settings.saturation_margin,
        poles=settings.gains().observer_poles,
        process_noise=np.diag(settings.process_noise),
        measurement_std=settings.measurement_std,
    )


def roll_law(settings: SteeringSettings) -> StepLaw:
    """Return the law of preset `best`; without flips the needle bends to the nearer side."""
    law, flips = RollLaw(RollLawSettings(**settings.turning)), settings.flip_depths
    return lambda estimate, insertion: law(estimate, bend_sign(flips, insertion))


def make_controller(
    settings: SteeringSettings,
    initial_rotation: npt.ArrayLike,
    entry: npt.ArrayLike | None = None,
    *,
    number: int = 0,
) -> tuple[Estimator, StepLaw]:
    """Return estimator and law of one needle: of the preset, or of another package if selected.

    Parameters
    ----------
    settings : SteeringSettings
        Preset and parameters.
    initial_rotation : array_like, shape (3, 3)
        Orientation at the entry with the base's rotation at 0, in `target_plane`.
    entry : array_like, shape (3,), optional
        Entry point in `target_plane` [m]; unknown by default.
    number : int
        Number of the needle in a study, part of the seed of another package's estimator.

    Raises
    ------
    OwnPartError
        An invalid estimator or law of another package.
    """
    estimator: Estimator
    if settings.estimator:
        part = checked_estimator(settings.estimator)
        rng = np.random.default_rng([settings.seed, number])
        estimator = OwnEstimator(part, settings, initial_rotation, entry, rng)
    elif settings.preset == "best":
        estimator = HypothesisFilter(filter_settings(settings), initial_rotation, entry)
    else:
        estimator = LuenbergerObserver(observer_settings(settings), initial_rotation)
    if settings.law:
        return estimator, OwnLaw(checked_law(settings.law), settings)
    return estimator, roll_law(settings) if settings.preset == "best" else make_law(settings)
