"""The point law within a preset: with a rig's settings."""

from __future__ import annotations

from needle_controller.laws.point_law import PointLaw
from needle_controller.laws.point_turns import PointLawSettings
from needle_controller.presets.steering_settings import SteeringSettings


def point_law(settings: SteeringSettings) -> PointLaw:
    """Return the law for points; `SteeringSettings.check_steers_to_points` says who can."""
    return PointLaw(_limited(settings))


def prompt_point_law(settings: SteeringSettings) -> PointLaw:
    """Return the law for points that turns the bevel at once: as paths are planned."""
    return PointLaw(
        _limited(settings)._replace(
            reserve=1.0, last_turn=0.0, last_turns_from=settings.step_length, dead_band=0.05
        )
    )


def _limited(settings: SteeringSettings) -> PointLawSettings:
    return PointLawSettings(
        step_length=settings.step_length,
        max_rotation_per_length=settings.max_rotation_per_length,
        max_winding=settings.max_winding,
    )
