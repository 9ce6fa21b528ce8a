"""Estimates of known needles, or of equally likely hypotheses."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_controller.filter.records import TORSION
from needle_controller.laws.roll_law import hypotheses_of
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import REDUCED
from needle_controller.observers.estimator import Estimate, Hypotheses

CURVATURE = 1.0 / 0.122
STEP = 0.001
CAP = np.deg2rad(30.0) / STEP


def known(coordinates: Array, std: float = 0.0) -> Estimate:
    """Return an estimate with (6,) coordinates and a standard deviation of the pitch [rad]."""
    covariance = np.zeros((6, 6))
    covariance[4, 4] = std**2
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[list(REDUCED)], CURVATURE),
        curvature=CURVATURE,
        covariance=covariance,
    )


def mixture(rolls: list[float], *, wound: float = 0.0, **first: float) -> Estimate:
    """Return equally likely torsions of a needle at its entry with these rolls [rad].

    `first` changes fields of the first one.
    """
    torsions = np.zeros(len(rolls), TORSION)
    torsions["roll"] = rolls
    torsions["agreement"] = torsions["gain"] = 1.0
    torsions["curvature"] = CURVATURE
    torsions["weight"] = 1.0 / len(rolls)
    for name, value in first.items():
        torsions[name][0] = value
    estimate = known(np.zeros(6))
    mean = hypotheses_of(estimate).mean
    mean["wound"] = wound
    return dataclasses.replace(estimate, hypotheses=Hypotheses(mean, torsions))
