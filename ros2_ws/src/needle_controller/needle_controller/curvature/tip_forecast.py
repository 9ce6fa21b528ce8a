"""Forecast of the tip from the first part of a pure insertion, with its uncertainty.

The uncertainty of an arc alone is too small, because the curvature varies slightly in real tissue.
So the path is an arc plus the effect of a local curvature c, a stationary random process:

    p(s) = arc(s) + integral over u < s of c(u) x (arc(s) - arc(u)) du,
    E[c(u) c(v)^T] = spread^2 exp(-|u - v| / length) across the path.

The curvature of the arc is normally distributed about 0 in each direction. Only the order of
magnitude of its standard deviation is known: each of `SCALES` is a hypothesis, weighted by the
evidence of the tips. So the uncertain arc of a stiff needle is not extrapolated as if it were
known, and that of a flexible needle is not straightened.
"""

from __future__ import annotations

import numpy as np

from needle_controller.curvature.curvature_fit import CurvatureFit
from needle_controller.curvature.insertion_arc import BEND, UNKNOWNS, arc_points, frame
from needle_controller.model.arrays import Array

LOCAL_SPREAD, LOCAL_LENGTH = 0.4, 0.02
"""Standard deviation of the local curvature [1/m], and its correlation length [m]: from 51
insertions of a stiff needle (2022-08-31 to 10-13 of maribernardes/trajcontrol_lisa), whose tips at
98 mm are within the 95 % intervals of a forecast from 50 mm in 96 % of cases."""
SCALES: Array = np.geomspace(0.05, 50.0, 13)
"""Standard deviations of the arc's curvature, with equal prior probabilities [1/m]."""
_CELL = 0.004
"""Length over which the local curvature is constant [m]."""


def forecast_tip(tips: Array, fit: CurvatureFit, insertion: float) -> tuple[Array, Array]:
    """Return the predicted tip at an insertion without rotation.

    Parameters
    ----------
    tips : ndarray, shape (K, 3)
        Measured tips in `rig` [m].
    fit : CurvatureFit
        Fit of the arc through the tips.
    insertion : float
        Insertion of the forecast, > 0, along the path if that of the tips is not known [m].

    Returns
    -------
    tip : ndarray, shape (3,)
        Predicted tip in `rig` [m].
    interval : ndarray, shape (3,)
        Half-width of each coordinate's 95 % interval, for the fitted noise [m].
    """
    settings, insertion_known = fit.settings, fit.insertion_known
    axes, entry = frame(np.asarray(settings.heading)), np.asarray(settings.entry)
    length = np.append(fit.length, insertion)
    stations = length * (1.0 + fit.unknowns[UNKNOWNS])
    points, slopes, tangents = arc_points(fit.unknowns[:UNKNOWNS], stations)
    design = np.concatenate(
        [slopes, (tangents * length[:, None])[..., None], _local_slopes(fit.unknowns, stations)],
        axis=-1,
    )
    residual = (tips - entry) @ axes - points[:-1]
    observed = design[:-1]
    if not insertion_known:
        # Only the residual across the path counts.
        along = tangents[:-1]
        residual = residual - along * np.sum(residual * along, axis=-1, keepdims=True)
        observed = observed - along[..., None] * np.einsum("ki,kij->kj", along, observed)[:, None]
    rows = observed.reshape(-1, observed.shape[-1])
    weighted = rows.T * np.repeat(fit.weights / fit.measurement_std**2, 3)
    information, pull = weighted @ rows, weighted @ residual.ravel()
    precision = _prior(settings.precision(), insertion_known, design.shape[-1])
    offset = np.zeros(design.shape[-1])
    offset[: UNKNOWNS + 1] = -fit.unknowns
    means, covariances, evidence = [], [], []
    for scale in SCALES:
        precision[BEND, BEND] = np.eye(2) * scale**-2.0
        # Least squares about the arc: (D^T W D + P) x = D^T W r + P x0
        covariance = np.linalg.inv(information + precision)
        right_side = pull + precision @ offset
        change = covariance @ right_side
        means.append(points[-1] + design[-1] @ change)
        covariances.append(design[-1] @ covariance @ design[-1].T)
        log_det = np.linalg.slogdet(covariance)[1] - 4.0 * np.log(scale)
        evidence.append(0.5 * (log_det + right_side @ change - offset @ precision @ offset))
    share = np.exp(np.array(evidence) - np.max(evidence))
    share /= np.sum(share)
    mean = share @ np.array(means)
    off = np.array(means) - mean
    spread = np.tensordot(share, np.array(covariances) + off[:, :, None] * off[:, None], 1)
    covariance = axes @ spread @ axes.T
    return entry + axes @ mean, 1.96 * np.sqrt(np.diagonal(covariance))


def _local_slopes(unknowns: Array, stations: Array) -> Array:
    """Return the derivatives of points with respect to each cell's curvature, (K, 3, 2 M) [m^2].

    Parameters
    ----------
    unknowns : ndarray, shape (8,)
        Unknowns of the arc.
    stations : ndarray, shape (K,)
        Positions of the points along the arc, the farthest last [m].
    """
    cells = np.arange(0.5 * _CELL, stations[-1], _CELL)
    points, _, _ = arc_points(unknowns[:UNKNOWNS], stations)
    positions, _, tangents = arc_points(unknowns[:UNKNOWNS], cells)
    first = np.array([1.0, 0.0, 0.0]) - tangents * tangents[:, :1]
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    turned = []
    for across in (first, np.cross(tangents, first)):
        # At u, the path turns by c du about an axis perpendicular to it.
        lever = points[:, None] - positions
        moved = np.cross(across, lever) * _CELL
        turned.append(np.where((stations[:, None] > cells)[..., None], moved, 0.0))
    return np.asarray(np.concatenate(turned, axis=1).transpose(0, 2, 1))


def _prior(precision: Array, insertion_known: bool, count: int) -> Array:
    """Return the inverse prior covariance of all unknowns except the arc's bend, (count, count)."""
    if not insertion_known:
        # The position along the path is that of the arc.
        precision = precision.copy()
        precision[2] = max(precision[2], 1e6)
    whole = np.zeros((count, count))
    whole[: UNKNOWNS + 1, : UNKNOWNS + 1] = np.diag(precision)
    cells = (count - UNKNOWNS - 1) // 2
    apart = np.abs(np.subtract.outer(np.arange(cells), np.arange(cells))) * _CELL
    local = np.linalg.inv(LOCAL_SPREAD**2 * np.exp(-apart / LOCAL_LENGTH))
    whole[UNKNOWNS + 1 :, UNKNOWNS + 1 :] = np.kron(np.eye(2), local)
    return whole
