"""Disturbances of a study (measurements, tissue, needle) and the random numbers behind them.

None of them is passed to the controller.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from typing import Any, TypeVar

import numpy as np
import scipy.special
from numpy.typing import NDArray

from needle_sim.needle.se3 import FloatArray

START, NOISE, OUTLIER, OUTLIER_DIRECTION, MISSED, CURVATURE, BUMP, TARGET, DRIFT, BREATH = range(10)
PUSH, ROLL, BIAS = range(10, 13)
"""Purposes of random numbers, each with its own stream."""
PER_NEEDLE = 4
"""Numbers per needle and draw: two needles share one block of the generator."""


def uniform_numbers(
    seed: int, purpose: int, step: int, first: int, count: int
) -> NDArray[np.float32]:
    """Return four numbers, uniform in [0, 1), for each needle.

    Needle, step and purpose form the counter of the Philox generator, so that neither chunks nor
    the order of calls change the numbers.

    Parameters
    ----------
    seed : int
        Seed of the study, >= 0.
    purpose : int
        One of `START` ... `BIAS`.
    step : int
        Number of the exposure, or another counter of the purpose.
    first, count : int
        The needles `first` ... `first + count - 1`.

    Returns
    -------
    ndarray, shape (count, 4)
        One row per needle; single precision, in steps of 2^-24.
    """
    block, skip = divmod(first, 2)
    bits = np.random.Philox(key=seed, counter=[block, step, purpose, 0])
    rows = np.random.Generator(bits).random((count + skip, PER_NEEDLE), dtype=np.float32)
    return rows[skip:]


def within_one(numbers: NDArray[np.float32]) -> FloatArray:
    """Return numbers, uniform in [-1, 1), from uniform ones in [0, 1)."""
    return np.asarray(2.0 * numbers.astype(np.float64) - 1.0)


def quantile_levels(numbers: NDArray[np.float32]) -> FloatArray:
    """Return uniform numbers as levels of finite quantiles.

    These are the centres of the 2^24 steps of a number, because the quantile of 0 is infinite.
    """
    return np.asarray(numbers.astype(np.float64) + 0.5**25)


def normal_numbers(numbers: NDArray[np.float32]) -> FloatArray:
    """Return standard normal numbers from uniform ones."""
    return np.asarray(scipy.special.ndtri(quantile_levels(numbers)))


def random_directions(numbers: NDArray[np.float32]) -> FloatArray:
    """Return unit vectors, uniform on the sphere, from the first two numbers of each row."""
    share = numbers.astype(np.float64)
    up = 2.0 * share[:, 0] - 1.0
    across = np.sqrt(1.0 - up * up)
    around = 2.0 * np.pi * share[:, 1]
    return np.stack([across * np.cos(around), across * np.sin(around), up], axis=-1)


Insertion = TypeVar("Insertion", float, FloatArray)
"""Insertion common to all needles, or one for each."""
PATCH_LENGTH = 0.020
"""Insertion over which the curvature is constant [m]."""
_NEGLIGIBLE = 1e-6


@dataclasses.dataclass(frozen=True)
class Disturbances:
    """Disturbances of a study; all are off by default.

    Attributes
    ----------
    noise : float
        Noise of a measured coordinate: maximum error if uniform, standard deviation if normal,
        scale if Student's t [m].
    noise_shape : str
        "uniform", "normal" or "student".
    noise_lasting : float
        Correlation of normal noise between successive exposures, in [0, 1).
    degrees_of_freedom : float
        Degrees of freedom of Student's t.
    bias_walk : float
        Maximum bias of a measured coordinate; the bias walks by a tenth of it per exposure [m].
    outliers : float
        Share of outliers, which deviate in a random direction.
    outlier_size : tuple of float
        Minimum and maximum distance of an outlier, uniform in between [m].
    found : float
        Share of exposures in which the tip is detected.
    delay : int
        Delay of a measurement in steps; the controller receives its age.
    hidden_delay : int
        Delay in steps that is hidden from the controller: the measurement appears to be new.
    curvature_scale : float
        Curvature of the plant as a multiple of the controller's assumption.
    curvature_patches : float
        Maximum relative error of the curvature, uniform, drawn every 20 mm for each needle.
    layer : tuple of float
        Factor of the curvature in a layer of tissue, and insertion at which the layer begins [m].
    push : float
        Curvature by which the tissue bends the path towards a direction perpendicular to z, which
        is fixed in space and drawn for each needle [1/m].
    rotation_gain : float
        Share of the base rotation that reaches the tip, before play and lag.
    roll_walk : float
        Random walk of the tip's rotation about its axis, over inserted length [rad/sqrt(m)].
    play : float
        Half width of the dead band of the shaft's torsion [rad].
    lag_length : float
        Lag of the shaft's torsion [m].
    slip : float
        Relative excess of the stage's motion over the needle's insertion, > -1.
    bump : float
        Distance by which the phantom moves with the needle at half the depth, in a random
        direction [m].
    """

    noise: float = 0.0
    noise_shape: str = "uniform"
    noise_lasting: float = 0.0
    degrees_of_freedom: float = 3.0
    bias_walk: float = 0.0
    outliers: float = 0.0
    outlier_size: tuple[float, float] = (0.005, 0.010)
    found: float = 1.0
    delay: int = 0
    hidden_delay: int = 0
    curvature_scale: float = 1.0
    curvature_patches: float = 0.0
    layer: tuple[float, float] = (1.0, 0.0)
    push: float = 0.0
    rotation_gain: float = 1.0
    roll_walk: float = 0.0
    play: float = 0.0
    lag_length: float = 0.0
    slip: float = 0.0
    bump: float = 0.0


def measured(
    tips: FloatArray, disturbances: Disturbances, seed: int, exposure: int, first: int
) -> FloatArray:
    """Return the measured tips of some needles.

    Exposure 0 is neither an outlier nor missing, because the rig waits at the known entry point
    until it has detected the tip.

    Parameters
    ----------
    tips : ndarray, shape (N, 3)
        The true tips [m].
    disturbances : Disturbances
        Disturbances of the study.
    seed, exposure, first : int
        Keys of the random numbers: seed of the study, exposure, first needle.

    Returns
    -------
    ndarray, shape (N, 3)
        The measured tips [m]; NaN where missing.
    """
    count = len(tips)
    if disturbances.noise_shape == "normal":
        errors = _normal_errors(disturbances.noise_lasting, seed, exposure, first, count)
    else:
        numbers = uniform_numbers(seed, NOISE, exposure, first, count)[:, :3]
        if disturbances.noise_shape == "student":
            level = quantile_levels(numbers)
            errors = scipy.special.stdtrit(disturbances.degrees_of_freedom, level)
        else:
            errors = within_one(numbers)
    noisy = tips + disturbances.noise * errors
    if exposure == 0:
        return noisy
    if disturbances.outliers > 0.0:
        chance = uniform_numbers(seed, OUTLIER, exposure, first, count)[:, 0]
        off = tips + _outliers(disturbances.outlier_size, seed, exposure, first, count)
        noisy = np.where((chance < disturbances.outliers)[:, np.newaxis], off, noisy)
    if disturbances.found < 1.0:
        chance = uniform_numbers(seed, MISSED, exposure, first, count)[:, 0]
        noisy[chance < 1.0 - disturbances.found] = np.nan
    return noisy


def patch_factors(patches: float, seed: int, patch: int, first: int, count: int) -> FloatArray:
    """Return the factor of each needle's curvature in one patch, (count,), within 1 +- patches."""
    numbers = uniform_numbers(seed, CURVATURE, patch, first, count)[:, 0]
    return np.asarray(1.0 + patches * within_one(numbers))


def bumps(distance: float, seed: int, first: int, count: int) -> FloatArray:
    """Return the displacement of each needle's phantom, (count, 3) [m]."""
    share = uniform_numbers(seed, BUMP, 0, first, count)
    return np.asarray(distance * random_directions(share))


def push_axes(push: float, seed: int, first: int, count: int) -> FloatArray:
    """Return the rotation of each needle's heading per inserted length, (count, 3) [rad/m].

    It rotates a heading along z towards a random direction perpendicular to z.
    """
    around = 2.0 * np.pi * uniform_numbers(seed, PUSH, 0, first, count)[:, 0]
    return np.asarray(push * np.stack([-np.sin(around), np.cos(around), 0.0 * around], axis=-1))


def roll_steps(spread: float, seed: int, step: int, first: int, count: int) -> FloatArray:
    """Return the random rotation of each tip in a step, (count,) [rad], normal."""
    share = uniform_numbers(seed, ROLL, step, first, count)[:, 0]
    return spread * normal_numbers(share)


class BiasWalk:
    """Random walk of the measurement bias over the exposures.

    Each coordinate starts within +-`largest`, walks up or down by a tenth of that, and is reflected
    at the bounds.

    Parameters
    ----------
    largest : float
        Maximum bias [m].
    seed, first, count : int
        Keys of the random numbers: seed of the study, first needle, number of needles.
    """

    def __init__(self, largest: float, seed: int, first: int, count: int) -> None:
        self._largest = largest
        self._key = seed, first, count
        numbers = uniform_numbers(seed, BIAS, 0, first, count)[:, :3]
        self._bias: FloatArray = largest * within_one(numbers)

    def at(self, exposure: int) -> FloatArray:
        """Return the bias of an exposure, (count, 3) [m]; call it for 0, 1, 2 and so on."""
        if exposure > 0:
            seed, first, count = self._key
            share = uniform_numbers(seed, BIAS, exposure, first, count)[:, :3]
            walked = self._bias + 0.1 * self._largest * np.where(share < 0.5, -1.0, 1.0)
            over = np.maximum(np.abs(walked) - self._largest, 0.0)
            self._bias = walked - 2.0 * np.copysign(over, walked)
        return self._bias


class DelayLine:
    """Delays measurements by a number of steps.

    The first measurement is not delayed; then nothing arrives until the second one is due.

    Parameters
    ----------
    steps : int
        Number of steps, >= 0.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._pending: collections.deque[tuple[FloatArray, Any]] = collections.deque()

    def push(self, tips: FloatArray, insertion: Insertion) -> tuple[FloatArray, Insertion]:
        """Add a measurement; return the one that arrives now.

        Parameters
        ----------
        tips : ndarray, shape (N, 3)
            Present measurement [m]; may have further columns.
        insertion : float, or ndarray, shape (N,)
            Present insertion [m].

        Returns
        -------
        tips : ndarray, shape (N, 3)
            Arriving measurement [m]; NaN if nothing arrives.
        age : float, or ndarray, shape (N,)
            Insertion since that measurement [m].
        """
        none = insertion - insertion
        if self._steps == 0:
            return tips, none
        self._pending.append((tips, insertion))
        if len(self._pending) <= self._steps:
            return np.full_like(tips, np.nan), none
        late, then = self._pending.popleft()
        return late, insertion - then


def _normal_errors(lasting: float, seed: int, exposure: int, first: int, count: int) -> FloatArray:
    """Return errors of variance 1 that are correlated with those of earlier exposures."""
    errors = np.zeros((count, 3))
    for back in range(exposure + 1):
        left = lasting**back
        if left < _NEGLIGIBLE:
            break
        # The error of exposure 0 has the stationary variance.
        left *= 1.0 if back == exposure else math.sqrt(1.0 - lasting * lasting)
        share = uniform_numbers(seed, NOISE, exposure - back, first, count)
        errors += left * normal_numbers(share[:, :3])
    return errors


def _outliers(
    size: tuple[float, float], seed: int, exposure: int, first: int, count: int
) -> FloatArray:
    share = uniform_numbers(seed, OUTLIER_DIRECTION, exposure, first, count)
    low, high = size
    return np.asarray(
        random_directions(share) * (low + (high - low) * share[:, 2:3].astype(np.float64))
    )
