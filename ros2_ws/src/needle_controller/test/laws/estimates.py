"""Estimates of needles that are known, or of equally likely hypotheses."""

from __future__ import annotations

import dataclasses

import numpy as np

from needle_controller.bank.hypothesis_mixture import (
    COLUMNS,
    T_AGREEMENT,
    T_CURVATURE,
    T_ROLL,
    T_WEIGHT,
    Hypotheses,
    MixtureEstimate,
)
from needle_controller.model.arrays import Array
from needle_controller.model.feedback_linearization import linearized_from_reduced
from needle_controller.model.kinematics import REDUCED
from needle_controller.observers.estimator import Estimate

CURVATURE = 1.0 / 0.122
STEP = 0.001
CAP = np.deg2rad(30.0) / STEP


def known(coordinates: Array, std: float = 0.0) -> Estimate:
    """Return what an estimator says that knows (..., 6) coordinates, the pitch to `std` [rad]."""
    curvature = np.full(coordinates.shape[:-1], CURVATURE)
    covariance = np.zeros((*coordinates.shape, 6))
    covariance[..., 4, 4] = std**2
    return Estimate(
        coordinates=coordinates,
        linearized=linearized_from_reduced(coordinates[..., REDUCED], curvature),
        curvature=curvature,
        warnings=(),
        covariance_of=lambda: covariance,
    )


def mixture(
    rolls: list[float], *, wound: float = 0.0, columns: dict[int, float] | None = None
) -> MixtureEstimate:
    """Return hypotheses of these rolls [rad], equally likely, of a needle at its entry.

    `columns` are of the first hypothesis, by their numbers.
    """
    table = np.zeros((len(rolls), COLUMNS))
    table[:, T_ROLL] = rolls
    table[:, T_AGREEMENT], table[:, T_CURVATURE] = 1.0, CURVATURE
    table[:, T_WEIGHT] = 1.0 / len(rolls)
    for column, value in (columns or {}).items():
        table[0, column] = value
    plain = known(np.zeros(6))
    fields = {field.name: getattr(plain, field.name) for field in dataclasses.fields(Estimate)}
    hypotheses = Hypotheses(table, np.zeros(()), np.asarray(wound), np.zeros(3))
    return MixtureEstimate(**fields, hypotheses=hypotheses)
