"""The observer's and the law's arithmetic for many needles, compiled: (5), (6), (9), (10).

Each function works on flat arrays, one row a needle, and in place. Angles are left out where their
sines and cosines do: within (6)'s region cos(pitch) and cos(roll) are positive square roots.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from needle_controller.model.arrays import Array
from needle_core.compiled import compiled


@compiled
def keep_inside(s2: float, sine: float, margin: float) -> float:
    """Return what scales s2 and s3 / kappa onto s2^2 + (s3 / kappa)^2 <= 1 - margin; <= 1."""
    squared = s2 * s2 + sine * sine
    if squared > 1.0 - margin:
        return float(np.sqrt((1.0 - margin) / squared))
    return 1.0


@compiled
def advance_states(
    states: Array,
    yaw: Array,
    saturated: npt.NDArray[np.bool_],
    motion: tuple[Array, Array],
    region: tuple[float, float],
) -> None:
    """Move linearized states on by what really happened.

    v is the one that takes the roll where (5) with u takes it over this length, held over it: (7)
    for short steps, and finite also where the needle only turned. Past +-90 deg s cannot follow.

    Parameters
    ----------
    states : ndarray, shape (N, 3)
        The linearized states s; changed.
    yaw : ndarray, shape (N,)
        [rad], by (4), trapezoidal; changed.
    saturated : ndarray of bool, shape (N,)
        Set to whether the estimate was projected.
    motion : tuple of ndarray, shape (N,)
        Inserted length [m] and rotation of the base [rad] of each needle.
    region : tuple of float
        kappa [1/m], and the estimate's distance from the border of (6)'s region, in [0, 1).
    """
    lengths, turns = motion
    curvature, margin = region
    per_curvature = 1.0 / curvature
    for i in range(states.shape[0]):
        length, turn = lengths[i], turns[i]
        s2, s3 = states[i, 1], states[i, 2]
        sine = s3 * per_curvature
        squared_cos_pitch = 1.0 - s2 * s2
        cos_pitch = np.sqrt(squared_cos_pitch)
        secant = 1.0 / cos_pitch
        sin_roll = sine * secant
        cos_roll = np.sqrt(squared_cos_pitch - sine * sine) * secant
        turn -= curvature * cos_roll * s2 * secant * length
        sin_turn, cos_turn = np.sin(turn), np.cos(turn)
        sin_turned = sin_roll * cos_turn + cos_roll * sin_turn
        # |roll| <= 90 deg: a turn takes it past +-90 deg on the side it turns to.
        if cos_roll * cos_turn - sin_roll * sin_turn < 0.0 or abs(turn) >= np.pi:
            sin_turned = np.copysign(1.0, turn)
        sin_pitched = s2 + length * s3
        cos_pitched = np.sqrt(max(1.0 - sin_pitched * sin_pitched, 0.0))
        added = curvature * cos_pitched * sin_turned - s3
        states[i, 0] += length * s2 + length * length * (0.5 * s3 + added / 6.0)
        s2 += length * (s3 + 0.5 * added)
        sine = (s3 + added) * per_curvature
        scale = keep_inside(s2, sine, margin)
        saturated[i] = scale < 1.0
        s2 *= scale
        sine *= scale
        states[i, 1] = s2
        states[i, 2] = sine * curvature
        squared_cos_pitch = 1.0 - s2 * s2
        slope = cos_roll * secant + np.sqrt(squared_cos_pitch - sine * sine) / squared_cos_pitch
        yaw[i] += 0.5 * length * curvature * slope


@compiled
def correct_states(
    states: Array,
    saturated: npt.NDArray[np.bool_],
    measured: tuple[Array, Array],
    gains: Array,
    region: tuple[float, float],
) -> None:
    """Correct linearized states by measured distances from the plane: (9).

    Parameters
    ----------
    states : ndarray, shape (N, 3)
        The linearized states s; changed.
    saturated : ndarray of bool, shape (N,)
        Set to whether the estimate was projected.
    measured : tuple of ndarray, shape (N,)
        x of the tips [m], NaN where there is none, and the length inserted since [m]; the tip is
        expected at x - age s2 + age^2 / 2 s3.
    gains : ndarray, shape (N, 3) or (1, 3)
        Gain on the innovation, for each needle or for all.
    region : tuple of float
        kappa [1/m], and the estimate's distance from the border of (6)'s region, in [0, 1).
    """
    tips, ages = measured
    curvature, margin = region
    per_curvature = 1.0 / curvature
    for i in range(states.shape[0]):
        j = i if gains.shape[0] > 1 else 0
        age = ages[i]
        s1, s2, s3 = states[i, 0], states[i, 1], states[i, 2]
        innovation = tips[i] - (s1 - age * s2 + 0.5 * age * age * s3)
        if np.isnan(innovation):
            innovation = 0.0
        s2 += gains[j, 1] * innovation
        sine = (s3 + gains[j, 2] * innovation) * per_curvature
        scale = keep_inside(s2, sine, margin)
        saturated[i] = scale < 1.0
        states[i, 0] = s1 + gains[j, 0] * innovation
        states[i, 1] = s2 * scale
        states[i, 2] = sine * curvature * scale


@compiled
def demand_states(
    states: Array,
    virtual_inputs: Array,
    curvatures: Array,
    held: tuple[float, float],
    demanded: tuple[Array, Array],
) -> None:
    """Work out where holding v over a step leads in (8), kept inside (6)'s region.

    Parameters
    ----------
    states : ndarray, shape (N, 3)
        The linearized states s.
    virtual_inputs : ndarray, shape (N,)
        v [1/m^2].
    curvatures : ndarray, shape (N,)
        kappa [1/m].
    held : tuple of float
        The step's length [m], and the demand's distance from the border of (6)'s region, in [0, 1).
    demanded : tuple of ndarray, shape (N,)
        Set to the sine and the cosine of the roll there, times cos(pitch).
    """
    length, margin = held
    sines, cosines = demanded
    for i in range(states.shape[0]):
        s2, s3, v = states[i, 1], states[i, 2], virtual_inputs[i]
        s2 += length * (s3 + 0.5 * length * v)
        sine = (s3 + length * v) / curvatures[i]
        scale = keep_inside(s2, sine, margin)
        s2 *= scale
        sine *= scale
        sines[i] = sine
        cosines[i] = np.sqrt(1.0 - s2 * s2 - sine * sine)
