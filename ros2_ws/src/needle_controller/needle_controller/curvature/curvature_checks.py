"""The curvature of one needle, without such priors as its tips contradict."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_controller.curvature.curvature_fit import (
    CurvatureFit,
    CurvatureFitSettings,
    checked_tips,
    fit_curvature,
)
from needle_core.errors import UserError

_CONTRADICTION = 4.0
"""Standard deviations beyond which the tips contradict a prior."""


@dataclasses.dataclass(frozen=True)
class CheckedFit:
    """A fit, and what of the settings the tips contradicted and was left out of it.

    Attributes
    ----------
    fit : CurvatureFit
        The fit.
    settings : CurvatureFitSettings
        Those it was made with.
    warnings : tuple of str
        A line on each that was not used.
    """

    fit: CurvatureFit
    settings: CurvatureFitSettings
    warnings: tuple[str, ...]


def fit_checked(
    tips: npt.ArrayLike, insertion: npt.ArrayLike | None, settings: CurvatureFitSettings
) -> CheckedFit:
    """Return the fit of one needle, without such priors as its tips contradict.

    An arc is first fitted without entry and heading; where it is more than four standard deviations
    from what was said to be known, that is not used.

    Parameters
    ----------
    tips : array_like, shape (K, 3)
        Measured tips [m].
    insertion : array_like, shape (K,), or None
        See `fit_curvature`.
    settings : CurvatureFitSettings
        What is known beside them.

    Returns
    -------
    CheckedFit
        The fit, and a line on everything that was not used.

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
    x, y, z = (float(v) for v in chord / size)
    e, f, g = (float(v) for v in first)
    free = fit_curvature(
        tips,
        insertion,
        dataclasses.replace(
            settings, heading=(x, y, z), heading_std=math.inf, entry=(e, f, g), entry_std=math.inf
        ),
    )
    warnings: list[str] = []
    if math.isfinite(settings.entry_std):
        off = np.asarray(free.entry) - settings.entry
        if insertion is None:
            # Along the arc the start of the free fit is arbitrary.
            off = off - free.heading * (off @ free.heading)
        distance = float(np.linalg.norm(off))
        allowed = _CONTRADICTION * math.hypot(settings.entry_std, float(free.entry_std))
        if distance > allowed:
            warnings.append(
                f"the entry was not used: the tips start {1e3 * distance:.1f} mm beside it, "
                f"wants <= {1e3 * allowed:.1f} mm"
            )
            settings = dataclasses.replace(settings, entry=(e, f, g), entry_std=math.inf)
    if math.isfinite(settings.heading_std):
        angle = math.acos(min(1.0, max(-1.0, float(free.heading @ np.asarray(settings.heading)))))
        allowed = _CONTRADICTION * math.hypot(settings.heading_std, float(free.heading_std))
        if angle > allowed:
            warnings.append(
                f"the heading was not used: the tips start {math.degrees(angle):.1f} deg off it, "
                f"wants <= {math.degrees(allowed):.1f} deg"
            )
            settings = dataclasses.replace(settings, heading=(x, y, z), heading_std=math.inf)
    return CheckedFit(fit_curvature(tips, insertion, settings), settings, tuple(warnings))
