"""Disturbances of a study: of the measured tips, of the tissue, and of the needle in it.

The controller is told of none of it.
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
from needle_sim.studies import study_noise

Insertion = TypeVar("Insertion", float, FloatArray)
"""Of all needles, or of each."""
NOISE_SHAPES = ("uniform", "normal")
PATCH_LENGTH = 0.020
"""Insertion over which the curvature stays the same [m]."""
_NOTHING_LEFT = 1e-6


@dataclasses.dataclass(frozen=True)
class Disturbances:
    """All that can go wrong; nothing does by default.

    Attributes
    ----------
    noise : float
        Largest error of a measured coordinate where the noise is uniform, its standard deviation
        where it is normal [m].
    noise_shape : str
        One of `NOISE_SHAPES`.
    noise_lasting : float
        Of normal noise, the correlation of an error with that of the exposure before, in [0, 1).
    outliers : float
        Share of measurements that are off in a random direction instead.
    outlier_size : tuple of float
        Least and largest distance by which an outlier is off, uniform in between [m].
    dropped : float
        Share of measurements that are missing.
    delay : int
        How many steps late a measurement arrives; the controller is told its age.
    untold_delay : int
        The same, but it comes as if it were new.
    curvature_scale : float
        The plant's curvature as a multiple of what the controller assumes.
    curvature_patches : float
        The curvature is off by up to this share, uniform, anew every 20 mm for each needle.
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
    outliers: float = 0.0
    outlier_size: tuple[float, float] = (0.005, 0.010)
    dropped: float = 0.0
    delay: int = 0
    untold_delay: int = 0
    curvature_scale: float = 1.0
    curvature_patches: float = 0.0
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
        share = study_noise.uniform(seed, study_noise.NOISE, exposure, first, count)
        _add_noise(tips, share, disturbances.noise, seen)
    if exposure == 0:
        return seen
    if disturbances.outliers > 0.0:
        chance = study_noise.uniform(seed, study_noise.OUTLIER, exposure, first, count)[:, 0]
        off = tips + _outliers(disturbances.outlier_size, seed, exposure, first, count)
        seen = np.where((chance < disturbances.outliers)[:, np.newaxis], off, seen)
    if disturbances.dropped > 0.0:
        chance = study_noise.uniform(seed, study_noise.MISSED, exposure, first, count)[:, 0]
        seen[chance < disturbances.dropped] = np.nan
    return seen


def patch_factors(patches: float, seed: int, patch: int, first: int, count: int) -> FloatArray:
    """Return what multiplies each needle's curvature in one patch, (count,), in 1 +- patches."""
    share = study_noise.uniform(seed, study_noise.CURVATURE, patch, first, count)[:, 0]
    return np.asarray(1.0 + patches * (2.0 * share.astype(np.float64) - 1.0))


def bumps(distance: float, seed: int, first: int, count: int) -> FloatArray:
    """Return by what the phantom of each needle is moved, (count, 3) [m]."""
    share = study_noise.uniform(seed, study_noise.BUMP, 0, first, count)
    return np.asarray(distance * study_noise.directions(share))


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

    def pass_on(self, tips: FloatArray, insertion: Insertion) -> tuple[FloatArray, Insertion]:
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
        share = study_noise.uniform(seed, study_noise.NOISE, exposure - back, first, count)
        # The middle of each of the 2^24 steps that a share has: 0 would be infinitely far off.
        errors += left * scipy.special.ndtri(share[:, :3].astype(np.float64) + 0.5**25)
    return errors


def _outliers(
    size: tuple[float, float], seed: int, exposure: int, first: int, count: int
) -> FloatArray:
    share = study_noise.uniform(seed, study_noise.OUTLIER_DIRECTION, exposure, first, count)
    low, high = size
    return np.asarray(
        study_noise.directions(share) * (low + (high - low) * share[:, 2:3].astype(np.float64))
    )
