"""Detection of contradictions between the boards of a calibration.

A wrong size of the squares or a wrong place hardly increases the reprojection errors, since the fit
compensates with cameras, index and surface, but all tips become wrong. The deviations of the fitted
parameters reveal the contradiction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.calibration_start import describe_apart
from needle_tracker.calibrating.rig_calibration import RigCalibration
from needle_tracker.calibrating.rig_fit import LARGEST_MISFIT_PX, misfit_px, rms_px
from needle_tracker.optics.calibration import SIDES

Array = NDArray[np.float64]

LARGEST_PULL = 4.0  # standard deviations of a place
LARGEST_SCALE_ERROR = 1e-3  # of the squares: 0.13 mm at the tip
_RINGS = 10
_RING_SIGMAS = 5.0  # 3.4 at most in 8 x 40 simulated sessions of lenses without a pattern
_LEAST_PATTERN_PX = 0.02


def contradictions(result: RigCalibration) -> list[str]:
    """Return the contradictions in a session as text; empty if consistent.

    Parameters
    ----------
    result : RigCalibration
        The calibration.
    """
    found = [text for view, text in misfits(result) if view.kind != "free"]
    if any(view.kind != "free" for view in result.apart):
        found.insert(0, describe_apart(result.apart))
    cause = "its lens has more distortion than k1, k2, k3, p1 and p2 describe"
    if "left.fx" not in result.parameters:
        cause = "the lens given with --lenses is for another camera, focus or image size"
    found += [
        f"{side} camera: corners are off by up to {miss:.2f} px in a pattern of rings: {cause}"
        for side, miss in ring_patterns(result).items()
    ]
    misfit = misfit_px(result.model, result.fit)
    if misfit > LARGEST_MISFIT_PX:
        found.append(
            f"corners are off by {misfit:.2f} px for an unknown reason: a board that is "
            "not flat, another lens, focus or image size than given"
        )
    error, sigma = result.square_error
    if abs(error) > max(LARGEST_SCALE_ERROR, LARGEST_PULL * sigma):
        found.append(
            f"the squares measure {100 * abs(error):.2f} +- {100 * sigma:.2f} % "
            f"{'larger' if error > 0.0 else 'smaller'} than in the session (tip errors scale with "
            "it): measure them again, and the places in air"
        )
    for name, distance, pull in _place_deviations(result):
        if pull > LARGEST_PULL:
            found.append(
                f"{name} is {1e3 * distance:.2f} mm ({pull:.0f} standard deviations) from "
                "its place in the session"
            )
    return found


def misfits(result: RigCalibration) -> list[tuple[BoardView, str]]:
    """Return the views with far larger corner errors than the others, each with a description.

    Parameters
    ----------
    result : RigCalibration
        The calibration.
    """
    model, residuals = result.model, result.fit.residuals
    errors = [
        (view, side, rms_px(residuals[model.seen_by[side] & (model.view_of == number)]))
        for number, view in enumerate(model.views)
        for side in SIDES
    ]
    # A camera that does not see a board has no error.
    typical = float(np.nanmedian([error for _, _, error in errors]))
    return [
        (
            view,
            f"{view.name}, {side} camera: {error:.2f} px rms, the others {typical:.2f}: check its "
            "place and that the board is flat",
        )
        for view, side, error in errors
        if error > 2.0 * typical + 0.05
    ]


def ring_patterns(result: RigCalibration) -> dict[str, float]:
    """Return the cameras with a radial pattern of corner errors, and its size [px].

    Noise averages out in a ring about the principal point, but missing terms of the distortion do
    not.

    Parameters
    ----------
    result : RigCalibration
        The calibration.
    """
    found = {}
    for side, camera in result.calibration.cameras.items():
        own = result.model.seen_by[side]
        outwards = result.model.pixels[own] - camera.camera_matrix[:2, 2]
        radii = np.linalg.norm(outwards, axis=-1)
        radial = np.sum(result.fit.residuals[own] * outwards, axis=-1) / np.maximum(radii, 1.0)
        rings = np.array_split(radial[np.argsort(radii)], _RINGS)
        means = np.array([np.mean(ring) for ring in rings])
        errors = np.array([np.std(ring) / np.sqrt(len(ring)) for ring in rings])
        if np.any((np.abs(means) > _RING_SIGMAS * errors) & (np.abs(means) > _LEAST_PATTERN_PX)):
            found[side] = float(np.abs(means).max())
    return found


def _place_deviations(result: RigCalibration) -> list[tuple[str, float, float]]:
    """Return the deviations of boards from places with a standard deviation.

    Each has the name of the view; the deviation of the centre of the board [m]; the largest
    deviation of its six parameters in standard deviations.
    """
    model, parameters = result.model, result.fit.parameters
    poses = model.board_poses(parameters)
    deviations = []
    for number, view in enumerate(model.views):
        if 0.0 < view.place.sigma < np.inf:
            own = slice(model.shared + 6 * number, model.shared + 6 * (number + 1))
            pull = np.abs(parameters[own] / model.given_sigma[own]).max()
            middle = np.append(view.left.points.mean(axis=0), 1.0)
            away = np.linalg.norm((poses[number] - view.place.T_rig_board) @ middle)
            deviations.append((view.name, float(away), float(pull)))
    return deviations
