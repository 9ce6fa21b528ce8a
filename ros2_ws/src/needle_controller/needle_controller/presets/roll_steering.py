"""The roll law within a preset: with a rig's settings, and with flips of the bevel."""

from __future__ import annotations

from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.laws.law import StepLaw
from needle_controller.laws.roll_law import RollLaw, RollLawSettings
from needle_controller.presets.control_settings import ControlSettings


def roll_law_settings(settings: ControlSettings) -> RollLawSettings:
    """Return what the roll law takes from a rig's settings; all else is its own."""
    return RollLawSettings(
        step_length=settings.step_length,
        max_rotation_per_length=settings.max_rotation_per_length,
        max_winding=settings.max_winding,
    )


def with_flips(law: RollLaw, plan: FlipPlan) -> StepLaw:
    """Return the law as it steers by a plan; without flips it bends to whatever side is nearer."""
    if not plan.depths:
        return lambda estimate, _: law(estimate)
    return lambda estimate, insertion: law(estimate, plan.bend_sign(insertion))
