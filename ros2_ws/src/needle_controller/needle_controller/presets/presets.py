"""The controllers a rig can be run with: an estimator and a law for each preset."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_common.errors import UserError
from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.laws.law import Law, LinearizingLaw, OpenLoopLaw, StepLaw
from needle_controller.model.gains import Gains
from needle_controller.observers.estimator import Estimator
from needle_controller.observers.luenberger import LuenbergerObserver, LuenbergerSettings
from needle_controller.presets.best import BestSettings, make_best
from needle_controller.presets.control_settings import OTHER_PRESETS, ControlSettings
from needle_controller.presets.other_presets import make_other_controller
from needle_controller.presets.roll_steering import roll_law_settings, with_flips


def make_law(settings: ControlSettings, gains: Gains) -> Law:
    """Return the law of preset `paper` or `open_loop`."""
    return OpenLoopLaw() if settings.preset == "open_loop" else linearizing_law(settings, gains)


def linearizing_law(settings: ControlSettings, gains: Gains) -> LinearizingLaw:
    """Return the law (7), (10) with these gains."""
    return LinearizingLaw(
        feedback=gains.feedback,
        step_length=settings.step_length,
        demand_margin=settings.demand_margin,
        max_rotation_per_length=settings.max_rotation_per_length,
    )


def observer_settings(settings: ControlSettings, gains: Gains) -> LuenbergerSettings:
    """Return what the observer of presets `paper` and `open_loop` assumes."""
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


def best_settings(settings: ControlSettings) -> BestSettings:
    """Return what preset `best` takes from a rig's settings; all else is its own."""
    return BestSettings(
        filter=FilterSettings(
            curvature=settings.curvature, tip_noise_bound=settings.tip_noise_bound
        ),
        law=roll_law_settings(settings),
    )


def make_controller(
    settings: ControlSettings, initial_rotation: npt.ArrayLike
) -> tuple[Estimator, StepLaw]:
    """Return a preset's estimator and law, for one needle or for as many as there will be tips.

    Parameters
    ----------
    settings : ControlSettings
        The preset and its numbers.
    initial_rotation : array_like, shape (3, 3)
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`.

    Raises
    ------
    UserError
        Weights that give no gains, or flips with a preset that cannot make them.
    """
    plan = FlipPlan(settings.flip_depths)
    if settings.preset == "best":
        estimator, roll_law = make_best(best_settings(settings), initial_rotation)
        return estimator, with_flips(roll_law, plan)
    gains = settings.gains()
    if settings.preset in OTHER_PRESETS:
        law = linearizing_law(settings, gains)
        return make_other_controller(settings, law, plan, initial_rotation)
    if plan.depths:
        raise UserError(
            f"flip_depths: preset {settings.preset} cannot steer with the bevel flipped (its "
            "coordinates end at roll +-90 deg); best can"
        )
    paper_law = make_law(settings, gains)
    observer = LuenbergerObserver(observer_settings(settings, gains), initial_rotation)
    return observer, lambda estimate, _: paper_law(estimate)
