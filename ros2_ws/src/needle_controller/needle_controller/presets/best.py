"""Preset `best`: the hypothesis filter and the roll law, with the numbers that were found for them.

Both work for one needle and for many, and neither knows of the other's settings.
"""

from __future__ import annotations

import dataclasses

import numpy.typing as npt

from needle_controller.bank.filter_settings import FilterSettings
from needle_controller.bank.hypothesis_filter import HypothesisFilter
from needle_controller.laws.roll_law import RollLaw, RollLawSettings


@dataclasses.dataclass(frozen=True)
class BestSettings:
    """What estimator and law of preset `best` are made of.

    Attributes
    ----------
    filter : FilterSettings
        The estimator's.
    law : RollLawSettings
        The law's.
    """

    filter: FilterSettings = dataclasses.field(default_factory=FilterSettings)
    law: RollLawSettings = dataclasses.field(default_factory=RollLawSettings)


def make_best(
    settings: BestSettings | None = None, initial_rotation: npt.ArrayLike | None = None
) -> tuple[HypothesisFilter, RollLaw]:
    """Return estimator and law of preset `best`, for one needle or for many.

    How many needles there are is said by the first tips, `HypothesisFilter.reset`.

    Parameters
    ----------
    settings : BestSettings, optional
        The defaults if not given.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`.
    """
    settings = BestSettings() if settings is None else settings
    return HypothesisFilter(settings.filter, initial_rotation), RollLaw(settings.law)
