"""Records of the hypothesis filter: hypothesis, needle, event, estimate, torsion, assumptions.

Compiled code reads and writes the fields by name. Everything is SI, in the frame `target_plane`.
"""

# Read by compiled code.
from __future__ import annotations

from typing import NamedTuple

import numpy as np

from needle_controller.model.arrays import Records

ERROR = 9
"""Length of a hypothesis's error: position [m], rotation vector [rad] (the true orientation is
exp(error) R, its axes those of `target_plane`), curvature [1/m], torsion parameter [rad] or [m],
insertion scale [-]."""
E_TURN, E_KAPPA, E_TORSION, E_SCALE = 3, 6, 7, 8
"""Index of each part in the error; the position comes first."""
NOISES = 6
"""Largest number of noise models of one shape."""
LONGEST_QUEUE = 64
NEAR = 1e-3
"""Distance from plane or point at which the target counts as reached, [KC09] IV-A [m]."""

HYPOTHESIS = np.dtype(
    [
        ("position", np.float64, 3),  # of the tip [m]
        ("rotation", np.float64, (3, 3)),  # of the tip; the heading is the last column
        ("curvature", np.float64),  # of the path [1/m]
        ("scale", np.float64),  # insertion of the needle per insertion of the stage
        ("play", np.float64),  # half width of the dead band between base and tip [rad]
        ("lag", np.float64),  # inserted length over which the tip's angle follows [m]; 0: none
        ("gain", np.float64),  # share of the base's rotation that reaches the shaft in the tissue
        ("tip_angle", np.float64),  # rotation of the tip since the start [rad]
        ("behind_play", np.float64),  # and of the shaft behind the play [rad]
        ("dtip_dtorsion", np.float64),  # derivative of tip_angle by the torsion parameter
        ("torsion_kind", np.int64),  # estimated parameter: PLAY, LAG or GAIN of `filter_settings`
        ("covariance", np.float64, (ERROR, ERROR)),
        ("noise_weights", np.float64, (3, NOISES)),  # probability of each noise model: per
        # coordinate if CORRELATED, otherwise in the first row
        ("residual", np.float64, 3),  # last tip minus its estimate after the update [m]
        ("heading_drift", np.float64),  # variance of pitch and yaw per length [rad^2/m]
        ("roll_drift", np.float64),  # and of the roll [rad^2/m]
        ("torsion", np.int64),  # number of the torsion hypothesis
        ("shape", np.int64),  # shape of the noise, see `filter_settings`
        ("weight", np.float64),  # relative probability; the heaviest has 1
        ("evidence", np.float64),  # likelihood of the last tip
        ("outlier", np.float64),  # probability that the last tip was an outlier
    ]
)
NEEDLE = np.dtype(
    [
        ("count", np.int64),  # number of hypotheses
        ("base", np.float64),  # rotation of the base since the start [rad]
        ("start_turn", np.float64),  # rotation of the base at the start [rad]
        ("outlier_probability", np.float64),  # probability that the last tip was an outlier
        ("mean_outlier_probability", np.float64),  # its running mean over the last tips
        ("tips", np.int64),  # number of tips used
        ("claimed", np.float64, 3),  # variance of each coordinate of the last tip [m^2]
        ("tip_too_late", np.bool_),  # whether the last tip was older than the previous one
        ("pending", np.int64),  # number of queued advances
        ("pending_length", np.float64, LONGEST_QUEUE),  # [m]
        ("pending_turn", np.float64, LONGEST_QUEUE),  # [rad]
        ("initial_rotation", np.float64, (3, 3)),  # at the entry, with the base at 0
        ("has_entry", np.bool_),  # whether the entry point is known
        ("entry", np.float64, 3),  # entry point [m]
        ("start", np.float64, 3),  # the first tip [m]
        ("start_insertion", np.float64),  # [m]
        ("inserted", np.float64),  # since the start [m]
        ("events", np.int64),  # number of recorded events; -1 after the first centimetres
        ("late", np.float64),  # hidden age of the tips [m]
        ("heading", np.float64, 4),  # measured with the next tip: unit vector and variance
        # [rad^2]; 0: not measured
    ]
)
EVENT = np.dtype(
    [
        ("length", np.float64),  # inserted before the tip [m]
        ("turn", np.float64),  # of the base [rad]
        ("is_tip", np.bool_),
        ("tip", np.float64, 3),  # [m]; NaN if it was not found
        ("covariance", np.float64, (3, 3)),  # [m^2]
        ("age", np.float64),  # [m]
        ("heading", np.float64, 4),  # as in NEEDLE
    ]
)
ESTIMATE = np.dtype(
    [
        ("coordinates", np.float64, 6),  # x, y, z [m], yaw, pitch, roll [rad]
        ("linearized", np.float64, 3),  # mean of the linearized states (6)
        ("uncertainty", np.float64, 3),  # var(x), cov(x, sin(pitch)), var(sin(pitch))
        ("covariance", np.float64, (6, 6)),  # of tip and rotation vector
        ("miss", np.float64),  # probability that the tip is farther than `NEAR` from the plane
        ("curvature", np.float64),  # [1/m]
        ("scale", np.float64),  # insertion scale
        ("noise", np.float64),  # relative to the claimed one
        ("ambiguous", np.float64),  # weight of rolls more than 60 deg from the likeliest
        ("base", np.float64),  # rotation of the base since the start [rad]
        ("wound", np.float64),  # position of the rotation joint [rad]
    ]
)
TORSION = np.dtype(
    [
        ("roll", np.float64),  # mean direction [rad]
        ("agreement", np.float64),  # of the rolls, 0..1
        ("curvature", np.float64),  # [1/m]
        ("tip_angle", np.float64),  # as in HYPOTHESIS; likewise the next four
        ("behind_play", np.float64),
        ("play", np.float64),
        ("lag", np.float64),
        ("gain", np.float64),
        ("weight", np.float64),  # 0 without hypotheses
    ]
)
"""Mean over all hypotheses of the same torsion, for the laws."""
ASSUMPTIONS = np.dtype(
    [
        ("noises", np.float64, (3, 3, NOISES)),  # multiples, shares, correlations of each shape
        ("curvature", np.float64),
        ("smallest_curvature", np.float64),
        ("largest_curvature", np.float64),
        ("curvature_drift", np.float64),
        ("scale_drift", np.float64),
        ("torsion_drift", np.float64, 3),  # of play, lag and gain
        ("effective_bound", np.float64),
        ("model_error", np.float64),
        ("outlier_share", np.float64),
        ("jump_share", np.float64),
    ]
)
"""`FilterSettings` for compiled code; standard deviations and drifts are squared if only their
squares are used."""


class Bank(NamedTuple):
    """Filters of N needles.

    Attributes
    ----------
    needles : ndarray of NEEDLE, shape (N,)
        The needles.
    hypotheses : ndarray of HYPOTHESIS, shape (N, H + 1)
        Storage for their hypotheses.
    events : ndarray of EVENT, shape (N, E)
        Storage for the events of the first centimetres.
    prior : ndarray of HYPOTHESIS, shape (H,)
        Hypotheses of a needle that enters along z with its base at 0.
    assumed : ndarray of ASSUMPTIONS, shape (1,)
        Assumptions of the filters.
    estimates, torsions : ndarray of ESTIMATE, TORSION, shape (N,), (N, K)
        Last estimates, and the mean over the hypotheses of each torsion.
    """

    needles: Records
    hypotheses: Records
    events: Records
    prior: Records
    assumed: Records
    estimates: Records
    torsions: Records
