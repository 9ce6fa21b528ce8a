"""Check of a calibration against a target at known places.

If a camera was touched, or the refractive index or the surface height has changed, both rays still
meet, but the tip is wrong. The measured corners of the target then deviate from their true
positions, and the pattern of these errors reveals the cause.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from needle_core.commands.cli import JsonValue
from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.calibration_start import checked_view
from needle_tracker.calibrating.rig_fit import (
    LARGEST_MISFIT_PX,
    RigFit,
    fit,
    misfit_px,
    rms_px,
)
from needle_tracker.calibrating.rig_model import (
    FIRST_WINDOW,
    POSE,
    RigModel,
    tip_error_p95,
    tip_shift_p95,
    unit_of,
)
from needle_tracker.optics.calibration import SIDES, StereoCalibration

Array = NDArray[np.float64]

CAMERAS = {f"{side}_camera_turned": [f"{side}.{name}" for name in POSE[:3]] for side in SIDES}
"""Parameters of a turned camera."""
LEAST_IMPROVEMENT = 30.0  # decrease of chi-squared by one cause: far above noise
EXPLAINED_PX = 1.0  # largest misfit that still counts as explained by the causes
TURN_LIMIT = np.deg2rad(0.01)  # a camera with a larger rotation was touched
_UNEXPLAINED = (
    "corners are off by {:.2f} px, which no turned camera, index or surface explains: {}, or other "
    "cameras"
)


@dataclasses.dataclass(frozen=True)
class Deviation:
    """A difference between rig and calibration.

    Attributes
    ----------
    cause : str
        One of `CheckResult.causes`.
    size, sigma : float
        Truth minus calibration, and its standard deviation [rad, m or -]; for a camera, the angle
        of its rotation (not negative).
    tip_error : float
        Resulting error of tips in the phantom, 95 % [m].
    """

    cause: str
    size: float
    sigma: float
    tip_error: float


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """Result of a check.

    Attributes
    ----------
    causes : tuple of str
        Possible causes: rotated cameras (`CAMERAS`), and the parameters of the windows
        (`RigModel.names`).
    deviations : list of Deviation
        Causes found, most significant first.
    tip_error : float
        Resulting error of tips in the phantom, 95 % [m]; NaN if no cause explains the views.
    unseen_tip_error : float
        Error of tips that this target cannot detect, 95 % [m].
    corner_sigma_px : float
        Standard deviation of the corners after the fit of all causes [px].
    reprojection_px : float
        Error of the corners with the calibration, rms [px].
    problems : list of str
        Reasons against the calibration; empty if it is good.
    """

    causes: tuple[str, ...]
    deviations: list[Deviation]
    tip_error: float
    unseen_tip_error: float
    corner_sigma_px: float
    reprojection_px: float
    problems: list[str]

    @property
    def ok(self) -> bool:
        """Whether the calibration is good."""
        return not self.problems


def check(calibration: StereoCalibration, views: list[BoardView], limit: float) -> CheckResult:
    """Compare a calibration with views of a target.

    Parameters
    ----------
    calibration : StereoCalibration
        The calibration.
    views : list of BoardView
        Views of the target, at known places or held freely in air.
    limit : float
        Largest acceptable error of tips in the phantom, 95 % [m].

    Returns
    -------
    CheckResult
        The result.

    Raises
    ------
    UserError
        A target that one camera does not detect, or that has no known place.
    """
    views = [checked_view(view) for view in views]
    model = RigModel(calibration, views)
    causes = (*CAMERAS, *model.names[FIRST_WINDOW:])
    everything = fit(model, model.start, _parameters(causes))
    sigma = everything.corner_sigma_px
    misfit = misfit_px(model, everything)
    unseen = tip_error_p95(calibration, everything.covariance)
    reprojection = rms_px(fit(model, model.start, (), sigma).residuals)
    if not misfit <= EXPLAINED_PX:
        problem = _UNEXPLAINED.format(
            misfit, "another target or place than in the session, left and right exchanged"
        )
        return CheckResult(causes, [], np.nan, unseen, sigma, reprojection, [problem])
    found = _causes(model, causes, sigma)
    best = fit(model, model.start, _parameters(found), sigma)
    deviations = [_deviation(model, best, cause) for cause in found]
    shift = tip_shift_p95(calibration, model.calibration(best.parameters))
    problems = []
    if misfit > LARGEST_MISFIT_PX:
        problems.append(_UNEXPLAINED.format(misfit, "another lens setting, a target not flat"))
    if shift > limit:
        problems.append(f"tips are off by {1e3 * shift:.2f} mm (95 %), allowed {1e3 * limit:g}")
    problems += [
        f"the {d.cause.split('_')[0]} camera was turned (or moved)"
        for d in deviations
        if d.cause in CAMERAS and d.size - 3.0 * d.sigma > TURN_LIMIT
    ]
    if unseen > limit:
        problems.append(
            f"this target cannot show tip errors below {1e3 * unseen:.2f} mm: lay it at known "
            "places on and under the surface, tilted"
        )
    return CheckResult(causes, deviations, shift, unseen, sigma, reprojection, problems)


def _causes(model: RigModel, causes: tuple[str, ...], sigma: float) -> list[str]:
    """Return the fewest causes that explain the views, the most significant first."""
    found: list[str] = []
    cost = fit(model, model.start, (), sigma).cost
    while len(found) < len(causes):
        costs = {
            cause: fit(model, model.start, _parameters([*found, cause]), sigma).cost
            for cause in causes
            if cause not in found
        }
        best = min(costs, key=lambda cause: costs[cause])
        if 2.0 * (cost - costs[best]) < LEAST_IMPROVEMENT:
            break
        found.append(best)
        cost = costs[best]
    return found


def _parameters(causes: Iterable[str]) -> list[str]:
    """Return the parameters of causes: rotations of cameras, and those of the windows."""
    return [name for cause in causes for name in CAMERAS.get(cause, [cause])]


def _deviation(model: RigModel, best: RigFit, cause: str) -> Deviation:
    columns = [model.names.index(name) for name in _parameters([cause])]
    change = (best.parameters - model.start)[columns]
    length = float(np.linalg.norm(change))
    towards = change / max(length, 1e-12)
    sigma = float(np.sqrt(towards @ best.covariance[np.ix_(columns, columns)] @ towards))
    size = length if cause in CAMERAS else float(change[0])
    alone = model.start.copy()
    alone[columns] = best.parameters[columns]
    error = tip_shift_p95(model.calibration(model.start), model.calibration(alone))
    return Deviation(cause, size, sigma, error)


def report(result: CheckResult) -> str:
    """Return a check as text."""
    lines = [
        f"corners are off by {result.reprojection_px:.3f} px rms (expected "
        f"{math.sqrt(2.0) * result.corner_sigma_px:.3f})"
    ]
    lines += [f"found: {_describe(deviation)}" for deviation in result.deviations]
    if {d.cause for d in result.deviations} >= set(CAMERAS):
        lines.append("both cameras turned, or the target is not at the session's place")
    if math.isfinite(result.tip_error):
        lines.append(
            f"tips in the phantom, 95 %: off by {1e3 * result.tip_error:.3f} mm; with this target "
            f"errors below {1e3 * result.unseen_tip_error:.3f} mm cannot be seen"
        )
    lines += [f"NOT OK: {problem}" for problem in result.problems]
    if result.ok:
        lines.append("OK")
    return "\n".join(lines)


def figures(result: CheckResult) -> dict[str, JsonValue]:
    """Return the figures of a check for --json; null for a cause that was not found."""
    values: dict[str, JsonValue] = {
        "ok": result.ok,
        "tip_error_p95_mm": 1e3 * result.tip_error,
        "unseen_tip_error_p95_mm": 1e3 * result.unseen_tip_error,
        "corner_sigma_px": result.corner_sigma_px,
        "reprojection_rms_px": result.reprojection_px,
        "problem": "; ".join(result.problems) or None,
    }
    found = {deviation.cause: deviation for deviation in result.deviations}
    for cause in result.causes:
        scale, unit = unit_of(cause)
        deviation = found.get(cause)
        key = f"{cause.replace('.', '_')}{'_error' if cause not in CAMERAS else ''}"
        key += unit and f"_{unit}"
        values[key] = None if deviation is None else scale * deviation.size
        values[f"sigma_{key}"] = None if deviation is None else scale * deviation.sigma
    return values


def _describe(deviation: Deviation) -> str:
    scale, unit = unit_of(deviation.cause)
    size, sigma = scale * deviation.size, scale * deviation.sigma
    effect = f"by itself {1e3 * deviation.tip_error:.3f} mm at the tip"
    if deviation.cause in CAMERAS:
        side = deviation.cause.split("_")[0]
        return f"{side} camera turned by {size:.4f} +- {sigma:.4f} deg (or moved); {effect}"
    name = deviation.cause.replace("_", " ").replace(".", " ")
    return (
        f"{name} is {size:+.4f} +- {sigma:.4f}{unit and f' {unit}'} off the calibration's; {effect}"
    )
