"""Checks of a curvature fit: priors that the tips contradict, and residuals along the arc."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import numpy.typing as npt

from needle_controller.curvature.curvature_fit import (
    CurvatureFit,
    CurvatureFitSettings,
    checked_tips,
    fit_curvature,
)
from needle_controller.model.arrays import Array
from needle_core.errors import UserError

_CLIPPED = 3.0  # limit of outliers [standard deviations]
_NEIGHBOURS = 8  # inverse of the share of the tips within which two are neighbours
_BY_CHANCE = 3.0  # limit of the significance [standard deviations]
_ALLOWED = 5e-5  # correlated error of a tracker [m]
_REPEATING = 2.5  # correlated error that is allowed, as a multiple of the repeating one
_MEDIAN = math.sqrt(2.0 * math.log(2.0))  # median length of a vector of two normal components
_CONTRADICTION = 4.0
"""Difference above which the tips contradict a prior [standard deviations]."""


def fit_checked(
    tips: npt.ArrayLike, insertion: npt.ArrayLike | None, settings: CurvatureFitSettings
) -> CurvatureFit:
    """Return the fit of one needle without the priors that its tips contradict.

    An arc is first fitted without entry and heading; a prior that differs from it by more than four
    standard deviations is not used.

    Parameters
    ----------
    tips : array_like, shape (K, 3)
        Measured tips [m].
    insertion : array_like, shape (K,), or None
        See `fit_curvature`.
    settings : CurvatureFitSettings
        Priors.

    Returns
    -------
    CurvatureFit
        The fit, with a warning for each unused prior.

    Raises
    ------
    UserError
        As `fit_curvature`.
    """
    tips = checked_tips(tips)
    third = max(len(tips) // 3, 1)
    first, last = np.median(tips[:third], axis=0), np.median(tips[-third:], axis=0)
    chord = last - first
    size = float(np.linalg.norm(chord))
    if size < 1e-4:
        raise UserError(f"the tips are all in one place (they move by {size:.3g} m)")
    any_entry: dict[str, Any] = {"entry": tuple(first.tolist()), "entry_std": math.inf}
    any_heading: dict[str, Any] = {
        "heading": tuple((chord / size).tolist()),
        "heading_std": math.inf,
    }
    unknown = dataclasses.replace(settings, **any_entry, **any_heading)
    free = fit_curvature(tips, insertion, unknown)
    off = np.asarray(free.entry) - settings.entry
    if insertion is None:
        # The start of the free fit is arbitrary along the arc.
        off = off - free.heading * (off @ free.heading)
    warnings: list[str] = []
    distance = float(np.linalg.norm(off))
    allowed = _CONTRADICTION * math.hypot(settings.entry_std, float(free.entry_std))
    if distance > allowed:
        warnings.append(
            f"the entry was not used: the tips start {1e3 * distance:.1f} mm from it, "
            f"limit {1e3 * allowed:.1f} mm"
        )
        settings = dataclasses.replace(settings, **any_entry)
    angle = math.acos(min(1.0, max(-1.0, float(free.heading @ np.asarray(settings.heading)))))
    allowed = _CONTRADICTION * math.hypot(settings.heading_std, float(free.heading_std))
    if angle > allowed:
        warnings.append(
            f"the heading was not used: the tips start {math.degrees(angle):.1f} deg off it, "
            f"limit {math.degrees(allowed):.1f} deg"
        )
        settings = dataclasses.replace(settings, **any_heading)
    fit = fit_curvature(tips, insertion, settings)
    return dataclasses.replace(fit, warnings=tuple(warnings))


def neighbour_correlation(residuals: Array) -> tuple[float, float]:
    """Return the part of the residuals that neighbouring tips have in common.

    Parameters
    ----------
    residuals : ndarray, shape (K, 3)
        Residual of each tip across its arc [m], in order.

    Returns
    -------
    shared : float
        Root mean square of the common part [m].
    significance : float
        Correlation relative to its standard deviation for independent errors [-].
    """
    lengths = np.linalg.norm(residuals, axis=-1)
    sigma = float(np.median(lengths)) / _MEDIAN
    clipped = residuals * np.minimum(1.0, _CLIPPED * sigma / np.maximum(lengths, 1e-12))[:, None]
    squared = np.sum(clipped**2, axis=-1)
    total, variance, pairs = 0.0, 0.0, 0
    for apart in range(1, len(residuals) // _NEIGHBOURS + 1):
        total += float(np.sum(clipped[apart:] * clipped[:-apart]))
        # The mean squared cosine of two independent directions across the arc is 1/2.
        variance += 0.5 * float(squared[apart:] @ squared[:-apart])
        pairs += len(residuals) - apart
    significance = total / math.sqrt(variance) if variance > 0.0 else 0.0
    return math.sqrt(max(total, 0.0) / max(pairs, 1)), significance


def check_independent_residuals(residuals: Array, repeating_error: float) -> None:
    """Check that the residuals of an arc are not correlated along it.

    Parameters
    ----------
    residuals : ndarray, shape (K, 3)
        Residual of each tip across its arc [m], in order.
    repeating_error : float
        Error that all tips may have in common [m].

    Raises
    ------
    UserError
        They are correlated, so the tips do not follow a single arc.
    """
    shared, significance = neighbour_correlation(residuals)
    allowed = max(_ALLOWED, _REPEATING * repeating_error)
    if shared > allowed and significance > _BY_CHANCE:
        raise UserError(
            f"the tips do not follow a single arc: in order they are {1e3 * shared:.2f} mm off "
            f"it, limit {1e3 * allowed:.2f} mm; the base turned during the insertion, or the "
            "tissue changes (--until-mm keeps the part before; a column rotation_rad shows turns)"
        )
