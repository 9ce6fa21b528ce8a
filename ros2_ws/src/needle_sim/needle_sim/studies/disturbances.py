"""Disturbances of a study (measurements, tissue, needle) and the random numbers behind them.

The controller is not told about any of them.
"""

from __future__ import annotations

import collections
import dataclasses
import math
from typing import Any, TypeVar

import numpy as np
import scipy.special
from numpy.typing import NDArray

from needle_core.compiled import compiled
from needle_sim.needle.se3 import FloatArray

START, NOISE, OUTLIER, OUTLIER_DIRECTION, MISSED, CURVATURE, BUMP, TARGET, DRIFT, BREATH = range(10)
PUSH, ROLL, BIAS = range(10, 13)
"""Purposes of random numbers."""
PER_NEEDLE = 4
"""Numbers for each needle and draw: two needles share one block of the generator."""


def uniform_numbers(
    seed: int, purpose: int, step: int, first: int, count: int
) -> NDArray[np.float32]:
    """Return four numbers, uniform in [0, 1), for each of some needles.

    Philox counts through its sequence by a number that can be set: needle, step and purpose are
    that number.

    Parameters
    ----------
    seed : int
        Of the study, >= 0.
    purpose : int
        One of `START` ... `BIAS`.
    step : int
        Number of the exposure, or of whatever the purpose counts.
    first, count : int
        The needles `first` ... `first + count - 1`.

    Returns
    -------
    ndarray, shape (count, 4)
        A row for each needle; single precision, in steps of 2^-24.
    """
    block, skip = divmod(first, 2)
    bits = np.random.Philox(key=seed, counter=[block, step, purpose, 0])
    rows = np.random.Generator(bits).random((count + skip, PER_NEEDLE), dtype=np.float32)
    return rows[skip:]


def quantile_levels(numbers: NDArray[np.float32]) -> FloatArray:
    """Return uniform numbers as levels at which a distribution has finite quantiles.

    That is the middle of each of the 2^24 steps that a number has: 0 would be infinitely far off.
    """
    return np.asarray(numbers.astype(np.float64) + 0.5**25)


def normal_numbers(numbers: NDArray[np.float32]) -> FloatArray:
    """Return normal numbers of variance 1 from as many uniform ones."""
    return np.asarray(scipy.special.ndtri(quantile_levels(numbers)))


def random_directions(numbers: NDArray[np.float32]) -> FloatArray:
    """Return unit vectors, uniform on the sphere, from the first two of some uniform numbers."""
    share = numbers.astype(np.float64)
    up = 2.0 * share[:, 0] - 1.0
    across = np.sqrt(1.0 - up * up)
    around = 2.0 * np.pi * share[:, 1]
    return np.stack([across * np.cos(around), across * np.sin(around), up], axis=-1)


Insertion = TypeVar("Insertion", float, FloatArray)
"""Of all needles, or of each."""
PATCH_LENGTH = 0.020
"""Insertion over which the curvature stays the same [m]."""
_NOTHING_LEFT = 1e-6


@dataclasses.dataclass(frozen=True)
class Disturbances:
    """All that can go wrong; nothing does by default.

    Attributes
    ----------
    noise : float
        Of a measured coordinate: the largest error where the noise is uniform, the standard
        deviation where it is normal, the scale where it is Student's t [m].
    noise_shape : str
        "uniform", "normal" or "student".
    noise_lasting : float
        Of normal noise, the correlation of an error with that of the exposure before, in [0, 1).
    degrees_of_freedom : float
        Of Student's t.
    bias_walk : float
        Largest bias of a measured coordinate, which walks by a tenth of it from one exposure to the
        next [m].
    outliers : float
        Share of measurements that are off in a random direction instead.
    outlier_size : tuple of float
        Least and largest distance by which an outlier is off, uniform in between [m].
    found : float
        Share of the exposures in which the tip is found.
    delay : int
        How many steps late a measurement arrives; the controller is told its age.
    untold_delay : int
        The same, but it comes as if it were new.
    curvature_scale : float
        The plant's curvature as a multiple of what the controller assumes.
    curvature_patches : float
        The curvature is off by up to this share, uniform, anew every 20 mm for each needle.
    layer : tuple of float
        Factor of the curvature in a layer of tissue, and the insertion from which on the needle is
        in it [m].
    push : float
        Curvature by which the tissue bends the path to one side, in a direction across z that is
        fixed in space and drawn for each needle [1/m].
    rotation_gain : float
        Share of the base's rotation that reaches the tip, before play and lag.
    roll_walk : float
        Standard deviation by which the tip turns about its axis by itself, over each metre of
        insertion [rad/sqrt(m)].
    play : float
        Dead band of the shaft's torsion, +- [rad].
    lag_length : float
        Lag of the shaft's torsion [m].
    slip : float
        Share by which the stage moves farther than the needle goes in, > -1.
    bump : float
        Distance by which the phantom, and the needle in it, is moved at half the depth, in a random
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
    untold_delay: int = 0
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
    """Return what is measured of some needles' tips.

    The first measurement, exposure 0, is neither an outlier nor missing: the needle rests at its
    entry point, which is known, and the rig waits there until it has seen the tip.

    Parameters
    ----------
    tips : ndarray, shape (N, 3)
        The true tips [m].
    disturbances : Disturbances
        What goes wrong.
    seed, exposure, first : int
        Key the randomness: of the study, the exposure and the first needle.

    Returns
    -------
    ndarray, shape (N, 3)
        The measured tips [m]; NaN where missing.
    """
    count = len(tips)
    seen = np.empty((count, 3))
    if disturbances.noise_shape == "normal":
        lasting = disturbances.noise_lasting
        seen[:] = tips + disturbances.noise * _normal_errors(lasting, seed, exposure, first, count)
    else:
        share = uniform_numbers(seed, NOISE, exposure, first, count)
        if disturbances.noise_shape == "student":
            level = quantile_levels(share[:, :3])
            errors = scipy.special.stdtrit(disturbances.degrees_of_freedom, level)
            seen[:] = tips + disturbances.noise * errors
        else:
            _add_noise(tips, share, disturbances.noise, seen)
    if exposure == 0:
        return seen
    if disturbances.outliers > 0.0:
        chance = uniform_numbers(seed, OUTLIER, exposure, first, count)[:, 0]
        off = tips + _outliers(disturbances.outlier_size, seed, exposure, first, count)
        seen = np.where((chance < disturbances.outliers)[:, np.newaxis], off, seen)
    if disturbances.found < 1.0:
        chance = uniform_numbers(seed, MISSED, exposure, first, count)[:, 0]
        seen[chance < 1.0 - disturbances.found] = np.nan
    return seen


def patch_factors(patches: float, seed: int, patch: int, first: int, count: int) -> FloatArray:
    """Return what multiplies each needle's curvature in one patch, (count,), in 1 +- patches."""
    share = uniform_numbers(seed, CURVATURE, patch, first, count)[:, 0]
    return np.asarray(1.0 + patches * (2.0 * share.astype(np.float64) - 1.0))


def bumps(distance: float, seed: int, first: int, count: int) -> FloatArray:
    """Return by what the phantom of each needle is moved, (count, 3) [m]."""
    share = uniform_numbers(seed, BUMP, 0, first, count)
    return np.asarray(distance * random_directions(share))


def push_axes(push: float, seed: int, first: int, count: int) -> FloatArray:
    """Return the rotation of each needle's heading per inserted length, (count, 3) [rad/m].

    It turns a heading along z towards a direction across z, uniform in angle.
    """
    around = 2.0 * np.pi * uniform_numbers(seed, PUSH, 0, first, count)[:, 0]
    return np.asarray(push * np.stack([-np.sin(around), np.cos(around), 0.0 * around], axis=-1))


def roll_steps(spread: float, seed: int, step: int, first: int, count: int) -> FloatArray:
    """Return by what each tip turns by itself in a step, (count,) [rad], normal."""
    share = uniform_numbers(seed, ROLL, step, first, count)[:, 0]
    return spread * normal_numbers(share)


class BiasWalk:
    """Bias of the measured tips that walks from one exposure to the next.

    Each coordinate starts anywhere within +-`largest`, walks up or down by a tenth of that, and is
    thrown back at the bounds.

    Parameters
    ----------
    largest : float
        [m].
    seed, first, count : int
        Key the randomness: of the study, the first needle, and how many there are.
    """

    def __init__(self, largest: float, seed: int, first: int, count: int) -> None:
        self._largest = largest
        self._key = seed, first, count
        share = uniform_numbers(seed, BIAS, 0, first, count)[:, :3]
        self._bias: FloatArray = largest * (2.0 * share.astype(np.float64) - 1.0)

    def at(self, exposure: int) -> FloatArray:
        """Return the bias of an exposure, (count, 3) [m]; called for 0, 1, 2 and so on."""
        if exposure > 0:
            seed, first, count = self._key
            share = uniform_numbers(seed, BIAS, exposure, first, count)[:, :3]
            walked = self._bias + 0.1 * self._largest * np.where(share < 0.5, -1.0, 1.0)
            over = np.maximum(np.abs(walked) - self._largest, 0.0)
            self._bias = walked - 2.0 * np.copysign(over, walked)
        return self._bias


class DelayLine:
    """Measurements that arrive some steps late.

    The first one arrives before the needle moves; until the second does, nothing arrives.

    Parameters
    ----------
    steps : int
        How many steps late, >= 0.
    """

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._under_way: collections.deque[tuple[FloatArray, Any]] = collections.deque()

    def push(self, tips: FloatArray, insertion: Insertion) -> tuple[FloatArray, Insertion]:
        """Take what was exposed now; return what arrives now.

        Parameters
        ----------
        tips : ndarray, shape (N, 3)
            Measured at this insertion [m]; further columns come along.
        insertion : float, or ndarray, shape (N,)
            Where the needles are now [m].

        Returns
        -------
        tips : ndarray, shape (N, 3)
            Measured earlier [m]; NaN if nothing arrives.
        age : float, or ndarray, shape (N,)
            Insertion since [m].
        """
        none = insertion - insertion
        if self._steps == 0:
            return tips, none
        self._under_way.append((tips, insertion))
        if len(self._under_way) <= self._steps:
            return np.full_like(tips, np.nan), none
        late, then = self._under_way.popleft()
        return late, insertion - then


@compiled
def _add_noise(
    tips: FloatArray, share: NDArray[np.float32], amplitude: float, seen: FloatArray
) -> None:
    for i in range(tips.shape[0]):
        for j in range(3):
            seen[i, j] = tips[i, j] + amplitude * (2.0 * share[i, j] - 1.0)


def _normal_errors(lasting: float, seed: int, exposure: int, first: int, count: int) -> FloatArray:
    """Return errors of variance 1, each with what is left of all those before."""
    errors = np.zeros((count, 3))
    for back in range(exposure + 1):
        left = lasting**back
        if left < _NOTHING_LEFT:
            break
        # The first is as large as all others together.
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
