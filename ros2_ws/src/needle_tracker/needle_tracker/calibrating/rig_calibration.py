"""Calibration of the whole rig by bundle adjustment.

A parameter that the views do not determine well enough keeps its given value, which is reported.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from needle_core.errors import UserError
from needle_tracker.calibrating.calibration_session import BoardView
from needle_tracker.calibrating.calibration_start import (
    LEAST_FREE_VIEWS,
    are_posed,
    calibrate_lenses,
    checked_views,
    consistent_views,
    first_calibration,
)
from needle_tracker.calibrating.rig_fit import (
    LEAST_CORNER_SIGMA_PX,
    RigFit,
    fit,
)
from needle_tracker.calibrating.rig_model import (
    FIRST_WINDOW,
    LENS,
    POSE,
    SQUARES,
    RigModel,
    tip_error_p95,
)
from needle_tracker.optics.calibration import (
    SIDES,
    StereoCalibration,
    Window,
    common_surface,
)

Array = NDArray[np.float64]

# Largest standard deviations of determined parameters: about 0.04 mm of depth for the surface,
# about a pixel in the corner of the image for the lens (f = 16 mm).
LIMITS = {
    "refractive_index": 0.003,
    "surface_height": 0.15e-3,
    "k1": 0.05,
    "k2": 1.0,
    "p1": 0.003,
    "p2": 0.003,
    "k3": 0.05,
}
_FIRST_SIGMA_PX = 10.0  # standard deviation of corners in the first fit of the poses
_FOCAL_LIMIT = 0.005  # largest sigma over focal length, or over image width for the centre
# Relative to the image width: in a box with a small board, a shifted principal point and a rotated
# camera are nearly equivalent, so that this uncertainty is harmless.
_OWN_WINDOWS_CENTRE_LIMIT = 0.01
_LARGEST_TURN = 0.2  # largest angle between a given relative pose and that of the views [rad]


@dataclasses.dataclass(frozen=True)
class Determined:
    """Result for one parameter; `sigma` comes from the views even if the given value was kept."""

    value: float
    sigma: float
    kept: bool


@dataclasses.dataclass(frozen=True)
class RigCalibration:
    """A calibrated rig.

    Attributes
    ----------
    calibration : StereoCalibration
        Calibration.
    fit : RigFit
        Parameters, covariance, residuals.
    model : RigModel
        Fitted model.
    parameters : dict of str to Determined
        By name: `left.fx` ... `right.k3`, and those of the windows (`RigModel.names`).
    square_error : (float, float)
        True size of the squares divided by the given one, minus 1, and its standard deviation. Only
        boards at known places determine it: a larger board held freely would look the same from
        farther away.
    tip_error_p95 : float
        Expected 95 % error of tips in the phantom from this calibration alone [m].
    apart : list of BoardView
        Rejected views, whose images do not belong together.
    """

    calibration: StereoCalibration
    fit: RigFit
    model: RigModel
    parameters: dict[str, Determined]
    square_error: tuple[float, float]
    tip_error_p95: float
    apart: list[BoardView]


def calibrate(
    views: list[BoardView],
    sizes: dict[str, tuple[int, int]],
    windows: tuple[Window, Window],
    lenses: StereoCalibration | None = None,
) -> RigCalibration:
    """Calibrate the rig from views of a board.

    Parameters
    ----------
    views : list of BoardView
        Views of boards held freely in air, on the surface, and in the phantom.
    sizes : dict of str to (int, int)
        Width and height of each side's images [px].
    windows : pair of Window
        Given windows of the left and the right camera.
    lenses : StereoCalibration, optional
        Cameras whose lenses are kept, as is their relative pose unless both are at one place.

    Returns
    -------
    RigCalibration
        The calibration and how well it is determined.

    Raises
    ------
    UserError
        A set of views that does not determine the cameras.
    """
    least_free = LEAST_FREE_VIEWS if lenses is None else 0
    views = checked_views(views, common_surface(*windows), least_free)
    cameras = lenses or calibrate_lenses(views, sizes, windows)
    views, apart, relative_pose = consistent_views(views, cameras, least_free)
    tied = are_posed(cameras)
    if tied and relative_pose is not None:
        _check_relative_pose(cameras.right.T_optical_rig, relative_pose)
    start = first_calibration(views, cameras)
    model = RigModel(start, views, tied=tied)
    names = model.names
    kinds = {name: name.split(".")[-1] for name in names}
    # With a given relative pose, the right camera moves with the left one.
    poses = {n for n, kind in kinds.items() if kind in POSE and not (tied and n[:5] == "right")}
    lens = [name for name, kind in kinds.items() if kind in LENS and lenses is None]
    surface = names[FIRST_WINDOW:]
    is_under = any(view.place.under_surface for view in views)
    free = {*poses, *lens, *(surface if is_under else ())}
    sigmas = dict.fromkeys(names, np.inf)
    parameters = model.start
    if start.surface is None:
        # The initial values ignore refraction: without a board at a known place in air, fit the
        # poses of cameras and boards first.
        parameters = fit(model, parameters, poses, _FIRST_SIGMA_PX).parameters
    while True:
        result = fit(model, parameters, free)
        fitted = zip(names, result.sigma, strict=False)
        sigmas |= {name: sigma for name, sigma in fitted if name in free}
        worst = _least_determined(names, result)
        if worst is None:
            break
        # As given: a window of the session, a lens without distortion.
        parameters, i = result.parameters.copy(), names.index(worst)
        parameters[i] = 0.0 if worst in lens else model.start[i]
        free.remove(worst)
    centre_limit = _OWN_WINDOWS_CENTRE_LIMIT if start.surface is None else _FOCAL_LIMIT
    _check_cameras(names, result, sizes, centre_limit)
    calibration = model.calibration(result.parameters)
    if not are_posed(calibration):
        raise UserError(
            "both cameras are estimated at one place: are left and right the same images?"
        )
    determined = {
        name: Determined(
            float(result.parameters[names.index(name)]), float(sigmas[name]), name not in free
        )
        for name in (*lens, *surface)
    }
    tip_error = tip_error_p95(calibration, result.covariance, tied=tied)
    corner_sigma = max(result.corner_sigma_px, LEAST_CORNER_SIGMA_PX)
    other = fit(model, result.parameters, free | {"square_size"}, corner_sigma)
    size = float(other.parameters[SQUARES]), float(other.sigma[SQUARES])
    return RigCalibration(calibration, result, model, determined, size, tip_error, apart)


def _check_relative_pose(given: Array, found: Array) -> None:
    """Reject a given relative pose that contradicts the views."""
    lengths = np.linalg.norm([given[:3, 3], found[:3, 3]], axis=-1)
    turn = np.abs(given[:3, :3] - found[:3, :3]).max()
    aside = np.abs(given[:3, 3] / lengths[0] - found[:3, 3] / lengths[1]).max()
    alike = max(turn, aside) < _LARGEST_TURN
    if not (alike and 0.9 < lengths[0] / lengths[1] < 1.1):
        raise UserError(
            f"--lenses puts the cameras {1e3 * lengths[0]:.4g} mm apart, the images put them "
            f"{1e3 * lengths[1]:.1f} mm apart"
            + (": is T in metres?" if alike else ": are left and right exchanged?")
        )


def _least_determined(names: tuple[str, ...], result: RigFit) -> str | None:
    """Return the free parameter that is farthest above its limit, if any."""
    limits = np.array([LIMITS.get(name.split(".")[-1], np.inf) for name in names])
    # The standard deviation of a fixed parameter is 0.
    ratios = result.sigma[: len(names)] / limits
    worst = int(ratios.argmax())
    return names[worst] if ratios[worst] > 1.0 else None


def _check_cameras(
    names: tuple[str, ...], result: RigFit, sizes: dict[str, tuple[int, int]], centre_limit: float
) -> None:
    for side in SIDES:
        for name in ("fx", "fy", "cx", "cy"):
            i = names.index(f"{side}.{name}")
            largest = centre_limit * float(sizes[side][0])
            if name[0] == "f":
                largest = _FOCAL_LIMIT * abs(float(result.parameters[i]))
            if not result.sigma[i] <= largest:
                raise UserError(
                    f"{side} camera: {name} is determined to +-{result.sigma[i]:.0f} px only "
                    f"({result.parameters[i]:.0f} px): add views tilted by 30 to 45 deg"
                )
