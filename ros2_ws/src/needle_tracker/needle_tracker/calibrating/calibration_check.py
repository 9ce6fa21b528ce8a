"""Finds the silent errors of a calibration by a target of known place.

A camera that was touched, another refractive index, a lower surface: both rays still meet, and the
tip is somewhere else. The target's corners do not come out where they are, and the pattern in which
they miss says why.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.calibration_start import boards_seen, checked_view
from needle_tracker.calibrating.rig_fit import (
    LARGEST_MISFIT_PX,
    RigFit,
    board_parameters_free,
    fit,
    misfit_px,
)
from needle_tracker.calibrating.rig_model import (
    CAMERA_PARAMETERS,
    LENS,
    BoardView,
    RigModel,
    camera_slice,
)
from needle_tracker.calibrating.tip_error import tip_error_p95, tip_shifts
from needle_tracker.optics.calibration import SIDES, StereoCalibration

Array = NDArray[np.float64]

CAMERAS = tuple(f"{side}_camera_turned" for side in SIDES)
LEAST_IMPROVEMENT = 30.0  # of chi squared: no noise does that
EXPLAINED_PX = 1.0  # a larger misfit, and the causes found explain nothing
NOTHING_SHOWN = 1.0  # an unseen error of tips from which on a target shows nothing at all [m]
TURN_LIMIT = np.deg2rad(0.01)  # a camera turned by more was touched, whatever it does to tips


@dataclasses.dataclass(frozen=True)
class Deviation:
    """One thing that is not as the calibration says.

    Attributes
    ----------
    cause : str
        One of `CheckResult.causes`.
    size, sigma : float
        Truth minus calibration, and its standard deviation [rad, m or -]; a camera's is the
        angle of its turn, not negative.
    tip_error : float
        What it does to tips in the phantom, 95 % [m].
    """

    cause: str
    size: float
    sigma: float
    tip_error: float


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """Verdict of a target on a calibration.

    Attributes
    ----------
    causes : tuple of str
        What was looked for: cameras that turned (`CAMERAS`), and what the windows' parameters are
        called (`RigModel.names`).
    deviations : list of Deviation
        What was found, the most telling first.
    tip_error : float
        What all of it together does to tips in the phantom, 95 % [m]; NaN where the causes do not
        explain what is seen.
    unseen_tip_error : float
        What errors this target could not show, 95 % [m].
    corner_sigma_px : float
        What the corners miss by when everything is fitted [px].
    reprojection_px : float
        What they miss by with the calibration as it is, rms [px].
    problems : list of str
        Why the calibration is not shown to be good; empty where it is.
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
        """Whether the calibration is shown to be good."""
        return not self.problems


def check(calibration: StereoCalibration, views: list[BoardView], limit: float) -> CheckResult:
    """Compare a calibration with what is seen of a target.

    Parameters
    ----------
    calibration : StereoCalibration
        What is to be checked.
    views : list of BoardView
        The target, at known places (or held freely in air).
    limit : float
        Largest error of tips in the phantom that is accepted, 95 % [m].

    Returns
    -------
    CheckResult
        What was found, and whether it is good enough.

    Raises
    ------
    UserError
        A target that one camera does not see, or none of known place.
    """
    views = [checked_view(view) for view in views]
    model = RigModel(calibration, views, boards_seen(calibration, views))
    causes = (*CAMERAS, *model.names[CAMERA_PARAMETERS:])
    everything = _fit(model, list(causes), None)
    sigma = everything.corner_sigma_px
    misfit = misfit_px(model, everything)
    covariance = everything.covariance[: model.shared, : model.shared]
    unseen = tip_error_p95(calibration, covariance)
    asis = _fit(model, [], sigma).residuals.reshape(-1, 2)
    reprojection = float(np.sqrt(np.mean(np.sum(asis**2, axis=-1))))
    if not misfit <= EXPLAINED_PX:
        problem = (
            f"corners miss by {misfit:.1f} px whatever turned camera, index or surface is assumed: "
            "another target or place than the session says, left and right exchanged, or other "
            "cameras"
        )
        return CheckResult(causes, [], np.nan, unseen, sigma, reprojection, [problem])
    found = _causes(model, causes, sigma)
    best = _fit(model, found, sigma)
    deviations = [_deviation(model, best, cause) for cause in found]
    shift = _p95(calibration, model.calibration(best.parameters))
    problems = []
    if misfit > LARGEST_MISFIT_PX:
        problems.append(
            f"corners miss by {misfit:.2f} px in a way that no turned camera, index or surface "
            "explains: another lens setting, or a target that is not flat or not where it is said"
        )
    if shift > limit:
        problems.append(f"tips are off by {1e3 * shift:.2f} mm (95 %), allowed {1e3 * limit:g}")
    problems += [
        f"the {d.cause.split('_')[0]} camera was turned (or moved)"
        for d in deviations
        if d.cause in CAMERAS and d.size - 3.0 * d.sigma > TURN_LIMIT
    ]
    if unseen > limit:
        problems.append(
            "this target cannot show errors of tips"
            + (f" below {1e3 * unseen:.2f} mm" if unseen < NOTHING_SHOWN else "")
            + ": lay it at known places on and under the surface, tilted"
        )
    return CheckResult(causes, deviations, shift, unseen, sigma, reprojection, problems)


def _causes(model: RigModel, causes: tuple[str, ...], sigma: float) -> list[str]:
    """Return the fewest causes that explain what is seen, the most telling first."""
    found: list[str] = []
    cost = _fit(model, found, sigma).cost
    while len(found) < len(causes):
        costs = {c: _fit(model, [*found, c], sigma).cost for c in causes if c not in found}
        best = min(costs, key=lambda cause: costs[cause])
        if 2.0 * (cost - costs[best]) < LEAST_IMPROVEMENT:
            break
        found.append(best)
        cost = costs[best]
    return found


def _fit(model: RigModel, causes: list[str], sigma: float | None) -> RigFit:
    free = board_parameters_free(model)
    for cause in causes:
        free[_columns(model, cause)] = True
    return fit(model, model.start, free, sigma)


def _columns(model: RigModel, cause: str) -> list[int]:
    """Return where a cause's parameters are: a camera's rotation, or one of the windows'."""
    if cause in CAMERAS:
        start = camera_slice(SIDES[CAMERAS.index(cause)]).start + len(LENS)
        return [start, start + 1, start + 2]
    return [model.names.index(cause)]


def _deviation(model: RigModel, best: RigFit, cause: str) -> Deviation:
    columns = _columns(model, cause)
    change = (best.parameters - model.start)[columns]
    size = float(change[0])
    sigma = float(best.sigma[columns[0]])
    alone = model.start.copy()
    alone[columns] = best.parameters[columns]
    if cause in CAMERAS:
        size = float(np.linalg.norm(change))
        towards = change / max(size, 1e-12)
        sigma = float(np.sqrt(towards @ best.covariance[np.ix_(columns, columns)] @ towards))
    error = _p95(model.calibration(model.start), model.calibration(alone))
    return Deviation(cause, size, sigma, error)


def _p95(assumed: StereoCalibration, true: StereoCalibration) -> float:
    return float(np.percentile(np.linalg.norm(tip_shifts(assumed, true), axis=-1), 95.0))
