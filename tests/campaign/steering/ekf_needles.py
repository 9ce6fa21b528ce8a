"""An extended Kalman filter with the roll law of `best`, the reference of the filter bank.

One needle is a position p, an orientation R and a curvature kappa; their error (dp, dtheta, dkappa)
has R_true = exp(dtheta) R in the frame of the plane. The filter knows no torsion, no jumps, no
outliers and one kind of noise: normal, of the variance of the claimed uniform errors.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from needle_controller.filter.records import ESTIMATE, TORSION
from needle_controller.laws.roll_law import RollLawSettings, bend_sign, roll_turn
from needle_controller.observers.luenberger import INITIAL_ROLL_STD
from needle_controller.presets.steering_settings import SteeringSettings
from needle_core.compiled import compiled
from needle_sim.needle.se3 import FloatArray
from needle_sim.studies.figures_of_merit import BAND, Belief

Records = npt.NDArray[np.void]

STATES = 7
ORIENTATION_DRIFT = math.radians(5.0) ** 2 / 0.1
"""Variance by which the orientation drifts over a length: 5 deg over 100 mm [rad^2/m]."""
CURVATURE_SPREAD = 0.2
"""Standard deviation of the curvature, relative to the assumed one."""
NEEDLE = np.dtype(
    [
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("curvature", np.float64),
        ("covariance", np.float64, (STATES, STATES)),
        ("base", np.float64),  # rotation of the base since the start [rad]
        ("moved", np.float64, 3),  # by the last step [m]
    ]
)


class EkfNeedles:
    """Filters and law of some needles; implements `study.Controller`.

    Parameters
    ----------
    tip_std : float
        Standard deviation of a measured coordinate [m].
    flip_depths : sequence of float
        Insertions at which the bevel is flipped, mirrored [m].
    step_length : float
        Insertion from one tip to the next [m].
    """

    def __init__(
        self, tip_std: float, flip_depths: tuple[float, ...] = (), step_length: float = 0.001
    ) -> None:
        known = SteeringSettings(step_length=step_length, flip_depths=flip_depths, depth=1.0)
        self._law = RollLawSettings(**known.turning)
        self._flips = flip_depths
        angles = (known.entry_angle_std, known.entry_angle_std, INITIAL_ROLL_STD)
        spread = [tip_std] * 3 + [*angles, CURVATURE_SPREAD * known.curvature]
        self._prior = np.diag(np.square(spread))
        self._curvature, self._variance = known.curvature, tip_std**2
        self._needles: Records = np.zeros(0, NEEDLE)
        self._moved: list[FloatArray] = []
        self._insertion = 0.0

    def start(self, tips: FloatArray) -> FloatArray:
        """Start with the first measured tips; see `study.Controller.start`."""
        self._needles = np.zeros(len(tips), NEEDLE)
        self._needles["position"] = tips
        self._needles["rotation"] = np.eye(3)
        self._needles["curvature"] = self._curvature
        self._needles["covariance"] = self._prior
        return self._rates()

    def step(
        self,
        d_insertion: float | FloatArray,
        d_rotation: FloatArray,
        tips: FloatArray,
        age: float | FloatArray,
    ) -> FloatArray:
        """Predict a step and correct with its tips; see `study.Controller.step`."""
        length = float(np.max(d_insertion))
        self._insertion += length
        _advance_all(self._needles, length, d_rotation)
        # Move a late tip on by the predicted motion since its exposure.
        self._moved.append(self._needles["moved"].copy())
        late = round(float(np.max(age)) / length)
        since = np.sum(self._moved[len(self._moved) - late :], axis=0) if late else 0.0
        _correct_all(self._needles, np.ascontiguousarray(tips + since), self._variance)
        return self._rates()

    def belief(self) -> Belief:
        """Return the estimate after the last step; see `study.Controller.belief`."""
        needles = self._needles
        known = np.array([_plane_uncertainty(needle) for needle in needles])
        x, sin_pitch = needles["position"][:, 0].copy(), needles["rotation"][:, 0, 2].copy()
        sigma = np.sqrt(known[:, 0])
        missed = norm.sf((BAND - x) / sigma) + norm.sf((BAND + x) / sigma)
        return Belief(x, sigma, sin_pitch, np.sqrt(known[:, 2]), missed)

    def _rates(self) -> FloatArray:
        turns = np.empty(self._needles.size)
        sign = bend_sign(self._flips, self._insertion)
        mean, only = np.zeros(1, ESTIMATE)[0], np.zeros(1, TORSION)
        _turn_all(self._needles, mean, only, sign, self._law, turns)
        return turns / self._law.step_length


@compiled
def _advance_all(needles: Records, length: float, turns: FloatArray) -> None:
    for n in range(needles.size):
        _advance(needles[n], length, turns[n])


@compiled
def _advance(needle: Any, length: float, turn: float) -> None:
    # omega = (kappa l, 0, turn): R' = R exp(omega), p' = p + l R exp(omega / 2) e3
    bend = needle.curvature * length
    middle = needle.rotation @ _rotation(0.5 * bend, 0.0, 0.5 * turn)
    needle.rotation[:] = needle.rotation @ _rotation(bend, 0.0, turn)
    needle.base += turn
    for i in range(3):
        needle.moved[i] = length * middle[i, 2]
        needle.position[i] += needle.moved[i]
    # dp' = dp + l dtheta x heading - l^2/2 e2 dkappa, dtheta' = dtheta + l e1 dkappa
    slopes = np.eye(STATES)
    heading = middle[:, 2]
    slopes[0, 4], slopes[0, 5] = length * heading[2], -length * heading[1]
    slopes[1, 5], slopes[1, 3] = length * heading[0], -length * heading[2]
    slopes[2, 3], slopes[2, 4] = length * heading[1], -length * heading[0]
    for i in range(3):
        slopes[i, 6] = -0.5 * length * length * middle[i, 1]
        slopes[3 + i, 6] = length * middle[i, 0]
    # P' = F P F^T + Q
    needle.covariance[:] = slopes @ needle.covariance @ slopes.T
    for i in range(3, 6):
        needle.covariance[i, i] += ORIENTATION_DRIFT * length


@compiled
def _rotation(x: float, y: float, z: float) -> FloatArray:
    """Return exp of a rotation vector, by Rodrigues' formula."""
    angle = math.sqrt(x * x + y * y + z * z)
    first = math.sin(angle) / angle if angle > 1e-9 else 1.0
    second = (1.0 - math.cos(angle)) / (angle * angle) if angle > 1e-9 else 0.5
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: FloatArray = np.eye(3) + first * cross + second * (cross @ cross)
    return turned


@compiled
def _correct_all(needles: Records, tips: FloatArray, variance: float) -> None:
    for n in range(needles.size):
        if math.isfinite(tips[n, 0] + tips[n, 1] + tips[n, 2]):
            _correct(needles[n], tips[n], variance)


@compiled
def _correct(needle: Any, tip: FloatArray, variance: float) -> None:
    covariance, error = needle.covariance, np.zeros(STATES)
    for i in range(3):
        # One coordinate after the other: K = P h / (h P h + r), h the unit vector of coordinate i
        gain = covariance[:, i] / (covariance[i, i] + variance)
        error += gain * (tip[i] - needle.position[i] - error[i])
        covariance -= np.outer(gain, covariance[i].copy())
    needle.position += error[:3]
    needle.curvature += error[6]
    # R <- exp(dtheta) R
    needle.rotation[:] = _rotation(error[3], error[4], error[5]) @ needle.rotation


@compiled
def _plane_uncertainty(needle: Any) -> FloatArray:
    """Return var(x), cov(x, sin(pitch)), var(sin(pitch)), (3,)."""
    # d sin(pitch) = (dtheta x heading)_x
    slope, covariance = np.zeros(STATES), needle.covariance
    slope[4], slope[5] = needle.rotation[2, 2], -needle.rotation[1, 2]
    across = covariance @ slope
    return np.array([covariance[0, 0], across[0], slope @ across])


@compiled
def _turn_all(
    needles: Records,
    mean: Any,
    only: Records,
    bend_sign: float,
    law: RollLawSettings,
    turns: FloatArray,
) -> None:
    for n in range(needles.size):
        needle, t = needles[n], only[0]
        # R = Rx(yaw) Ry(pitch) Rz(roll)
        t.roll = math.atan2(-needle.rotation[0, 1], needle.rotation[0, 0])
        t.curvature = max(needle.curvature, 1.0)
        t.tip_angle = t.behind_play = needle.base
        t.agreement = t.weight = t.gain = 1.0
        mean.linearized[0], mean.linearized[1] = needle.position[0], needle.rotation[0, 2]
        mean.uncertainty[:] = _plane_uncertainty(needle)
        mean.base = mean.wound = needle.base
        turns[n] = roll_turn(mean, only, bend_sign, law)[0]
