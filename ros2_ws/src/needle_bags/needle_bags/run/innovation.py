"""Innovation of each measured tip, and its margin to the gate that rejects tips."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right

import numpy as np
import numpy.typing as npt

from needle_bags.reading.bag_reader import Run, Stamps
from needle_bags.run.run_summary import target_offset
from needle_controller.model.arc_motion import arc, cross_matrix
from needle_controller.model.kinematics import rotation_from_quaternion

Floats = npt.NDArray[np.float64]

QUANTILE_95 = 7.815
"""95 % of a chi-squared variable with three degrees of freedom."""


@dataclasses.dataclass(frozen=True)
class Innovations:
    """Measured minus predicted tip, for every used tip except the first.

    The prediction is the estimate at the previous tip, advanced by the motion of the joints along
    an arc of the configured curvature.

    Attributes
    ----------
    stamps : (N,) int64
        Exposures [ns].
    values : (N, 3) float64
        Innovation in the axes of the target plane [m].
    sigmas : (N, 3) float64
        Its predicted standard deviations [m], of estimate and measurement together.
    squared : (N,) float64
        Innovation squared, normalised by its covariance [-]; 3 on average for a consistent filter.
    """

    stamps: Stamps
    values: Floats
    sigmas: Floats
    squared: Floats


@dataclasses.dataclass(frozen=True)
class GateRoom:
    """Margin of every measured tip to the gate.

    Attributes
    ----------
    stamps : (N,) int64
        Exposures [ns].
    reach : (N,) float64
        Distance from the entry point beyond the insertion [m].
    jump : (N,) float64
        Distance from the last used tip beyond the motion of the needle [m]; NaN at the first.
    margin : float or None
        Upper limit of both [m]; None if the bag lacks it.
    """

    stamps: Stamps
    reach: Floats
    jump: Floats
    margin: float | None


def innovations(run: Run) -> Innovations | None:
    """Return the innovations of a run; None without estimates, joints or the curvature."""
    curvature = run.parameter("plane_controller", "curvature")
    here, there = run.estimate.at(run.tips.stamps)
    if not isinstance(curvature, (int, float)) or len(here) < 2 or not len(run.joints):
        return None
    stamps = run.estimate.stamps[here]
    position, rotation = (
        run.estimate.values[here, :3],
        rotation_from_quaternion(run.estimate.values[here, 3:]),
    )
    covariance = run.estimate_covariances.values[here].reshape(-1, 6, 6)
    inserted, turned = np.diff(run.joints_at(stamps), axis=0).T
    shift = arc(np.maximum(inserted, 0.0), turned, curvature).shift
    moved = np.einsum("nij,nj->ni", rotation[:-1], shift)
    measured = run.tips.values[there] - np.array([target_offset(run), 0.0, 0.0])
    values = measured[1:] - position[:-1] - moved
    # A rotation error w of the estimate, about fixed axes, displaces the prediction by w x moved.
    jacobian = np.concatenate(
        [np.broadcast_to(np.eye(3), (len(moved), 3, 3)), -cross_matrix(moved)], axis=2
    )
    expected = jacobian @ covariance[:-1] @ np.swapaxes(jacobian, 1, 2)
    expected = expected + _measurement_covariances(run, stamps[1:])
    variances = np.diagonal(expected, axis1=1, axis2=2)
    good = np.isfinite(values).all(axis=1) & (variances > 0.0).all(axis=1)
    good &= np.isfinite(expected).all(axis=(1, 2))
    values, expected = values[good], expected[good]
    squared = np.einsum("ni,ni->n", values, np.linalg.solve(expected, values[..., None])[..., 0])
    return Innovations(stamps[1:][good], values, np.sqrt(variances[good]), squared)


def gate_room(run: Run) -> GateRoom:
    """Return how far the tips of a run were from being rejected."""
    finite = np.isfinite(run.tips.values).all(axis=1)
    stamps, tips = run.tips.stamps[finite], run.tips.values[finite]
    insertion = run.insertion_at(stamps)
    reach = np.linalg.norm(tips, axis=1) - np.maximum(insertion, 0.0)
    jump = np.full(len(stamps), np.nan)
    used = np.flatnonzero(np.isin(stamps, run.estimate.stamps))
    last = np.searchsorted(used, np.arange(len(stamps))) - 1
    known = last >= 0
    before = used[last[known]]
    jump[known] = np.linalg.norm(tips[known] - tips[before], axis=1) - np.abs(
        insertion[known] - insertion[before]
    )
    margin = run.parameter("plane_controller", "tip_margin")
    return GateRoom(stamps, reach, jump, margin if isinstance(margin, float) else None)


def rejected_tips(run: Run) -> Stamps:
    """Return the stamps of tips that the controller rejected [ns].

    The status counts them: each increment belongs to the last unused tip received before it.
    """
    unused = ~np.isin(run.tips.stamps, run.estimate.stamps)
    order = np.argsort(run.tips.received[unused])
    received = run.tips.received[unused][order].tolist()
    stamps = run.tips.stamps[unused][order].tolist()
    rejected: list[int] = []
    for status in run.controller_status:
        text = status.values.get("tips_rejected", "")
        if not text.isdigit() or int(text) <= len(rejected):
            continue
        come = bisect_right(received, status.log_time)
        free = [stamp for stamp in stamps[:come] if stamp not in rejected]
        rejected += free[len(rejected) - int(text) :]
    return np.array(sorted(rejected), np.int64)


def missed_tips(run: Run) -> Stamps:
    """Return the stamps of exposures in which no tip was found [ns]."""
    infinite = ~np.isfinite(run.tip_covariances.values).all(axis=1)
    stamps: Stamps = run.tip_covariances.stamps[infinite]
    return stamps


def _measurement_covariances(run: Run, stamps: Stamps) -> Floats:
    """Return each tip's covariance, (N, 3, 3); the configured one for tips without."""
    configured = run.parameter("plane_controller", "measurement_std")
    sigma = configured if isinstance(configured, float) else 0.0
    matrices: Floats = np.tile(np.eye(3) * sigma**2, (len(stamps), 1, 1))
    here, there = run.tip_covariances.at(stamps)
    matrices[there] = run.tip_covariances.values[here].reshape(-1, 3, 3)
    return matrices
