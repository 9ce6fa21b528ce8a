"""The roll law within a preset: with a rig's settings, and with flips of the bevel."""

from __future__ import annotations

from needle_controller.laws.flip_plan import FlipPlan
from needle_controller.laws.law import StepLaw
from needle_controller.laws.roll_law import RollLaw
from needle_controller.laws.roll_turns import RollLawSettings
from needle_controller.presets.steering_settings import SteeringSettings


def roll_law(settings: SteeringSettings, plan: FlipPlan) -> StepLaw:
    """Return the law as it steers by a plan; without flips it bends to whatever side is nearer."""
    law = RollLaw(
        RollLawSettings(
            step_length=settings.step_length,
            max_rotation_per_length=settings.max_rotation_per_length,
            max_winding=settings.max_winding,
        )
    )
    if not plan.depths:
        return lambda estimate, _: law(estimate)
    return lambda estimate, insertion: law(estimate, plan.bend_sign(insertion))
