"""Estimates the roll alone, from a measured position and a measured pitch ([KC09] section V).

With x and pitch measured, s1 and s2 = sin(pitch) of (6) are known and a reduced-order observer has
one state left, s3. In the paper's continuous terms: d(s3)/dl = v + p (ds2/dl - s3), with pole -p;
sampled over an inserted length l, the gain on the innovation of s2 is (1 - exp(-p l)) / l, which
leaves the error exp(-p l) of what it was. The price is that nothing smooths x and pitch: they are
as noisy as they were measured.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from needle_common.errors import OutOfBoundsError
from needle_controller.model.arrays import Array
from needle_controller.observers.estimator import Estimate
from needle_controller.observers.innovation_gate import InnovationGate
from needle_controller.observers.linear_observer import LinearObserver, LinearObserverSettings


@dataclasses.dataclass(frozen=True)
class PitchObserverSettings:
    """What the reduced-order observer assumes.

    Attributes
    ----------
    linear : LinearObserverSettings
        Curvature, noise, entry, saturation and gate; its `observer_poles` are not used.
    pitch_std : float
        Standard deviation of a measured pitch [rad].
    pole : float
        p, how fast the error of s3 decays per inserted length [1/m].

    Raises
    ------
    OutOfBoundsError
        A number that is not above 0.
    """

    linear: LinearObserverSettings
    pitch_std: float = math.radians(2.0)
    pole: float = 15.0

    def __post_init__(self) -> None:
        """Check every field."""
        for name, unit in (("pitch_std", "rad"), ("pole", "1/m")):
            value = float(getattr(self, name))
            if not (math.isfinite(value) and value > 0.0):
                raise OutOfBoundsError(name, value, np.nextafter(0.0, 1.0), math.inf, unit)


class PitchObserver(LinearObserver):
    """Reduced-order observer; see `estimator.Estimator`.

    `correct` takes the measured pitch beside the tip. x without pitch is taken as it is and the
    rest predicted; so is everything where no tip was found.

    Parameters
    ----------
    settings : PitchObserverSettings
        What is assumed.
    initial_rotation : array_like, shape (3, 3), optional
        Orientation of a needle at its entry with the base's rotation at 0, in `target_plane`.
    """

    def __init__(
        self, settings: PitchObserverSettings, initial_rotation: npt.ArrayLike | None = None
    ) -> None:
        self.pitch_settings = settings
        self._pitch_gate = InnovationGate(settings.linear.gate)
        super().__init__(settings.linear, initial_rotation)

    def reset(self, tip: npt.ArrayLike, joints: npt.ArrayLike) -> None:
        """Start at a first measurement; see `Estimator.reset`."""
        self._pitch_gate.reset()
        # Not a number before the first pitch: that one says nothing of how the pitch changes.
        self._since_pitch: Array = np.full((), np.nan)
        super().reset(tip, joints)

    def advance(self, d_insertion: npt.ArrayLike, d_rotation: npt.ArrayLike) -> None:
        """Move on by what really happened; see `Estimator.advance`."""
        super().advance(d_insertion, d_rotation)
        self._since_pitch = self._since_pitch + np.asarray(d_insertion, dtype=float)

    def correct(
        self,
        tip: npt.ArrayLike,
        covariance: npt.ArrayLike | None = None,
        age: npt.ArrayLike = 0.0,
        *,
        pitch: npt.ArrayLike = math.nan,
        pitch_std: npt.ArrayLike | None = None,
    ) -> None:
        """Take a measurement; see `Estimator.correct`.

        Parameters
        ----------
        tip : array_like, shape (..., 3)
            The tip [m]; NaN where it was not found.
        covariance : array_like, shape (..., 3, 3), optional
            Its covariance [m^2].
        age : array_like, shape (...)
            Length inserted since the exposure [m].
        pitch : array_like, shape (...)
            The shaft's pitch in `target_plane` at the tip, from the same exposure [rad]; NaN where
            it was not measured.
        pitch_std : array_like, shape (...), optional
            Its standard deviation [rad].
        """
        tip, age = np.asarray(tip, dtype=float), np.asarray(age, dtype=float)
        angle = np.asarray(pitch, dtype=float)
        found = np.all(np.isfinite(tip), axis=-1)
        linear, settings = self.settings, self.pitch_settings
        noise = np.asarray(linear.measurement_std**2)
        if covariance is not None:
            covariance = np.asarray(covariance, dtype=float)
            noise = covariance[..., 0, 0]
            found = found & np.isfinite(noise)
            noise = np.where(np.isfinite(noise), noise, 1.0)
        std = np.asarray(settings.pitch_std if pitch_std is None else pitch_std, dtype=float)
        seen = found & np.isfinite(angle) & np.isfinite(std)
        sine_noise = np.where(np.isfinite(std), (std * np.cos(self._reduced()[..., 1])) ** 2, 1.0)

        # What the exposure should have shown: s at `age` ago.
        s, p = self._s, self._covariance
        row1 = np.stack([np.ones_like(age), -age, 0.5 * age**2], axis=-1)
        row2 = np.stack([np.zeros_like(age), np.ones_like(age), -age], axis=-1)
        innovation1 = np.where(found, tip[..., 0] - np.sum(row1 * s, axis=-1), 0.0)
        with np.errstate(invalid="ignore"):
            innovation2 = np.where(seen, np.sin(angle) - np.sum(row2 * s, axis=-1), 0.0)
        use1 = self._gate.admit(innovation1**2 / (_variance(p, row1) + noise), found)
        use2 = self._pitch_gate.admit(innovation2**2 / (_variance(p, row2) + sine_noise), seen)
        use2 = use2 & use1

        since = self._since_pitch
        safe = np.where(since > 0.0, since, 1.0)
        rate = np.where(since > 0.0, -np.expm1(-settings.pole * since) / safe, 0.0)
        shape = np.broadcast_shapes(use1.shape, use2.shape, rate.shape)
        gain = np.zeros((*shape, 3, 2))
        gain[..., 0, 0] = use1
        gain[..., 1, 1] = use2
        gain[..., 2, 1] = np.where(use2, rate, 0.0)
        added = gain[..., 0] * innovation1[..., None] + gain[..., 1] * innovation2[..., None]
        self._take(s + added)
        rows = np.stack(np.broadcast_arrays(row1, row2), axis=-2)
        keep = np.eye(3) - gain @ rows
        noises = np.stack(np.broadcast_arrays(noise, sine_noise), axis=-1)
        self._covariance = keep @ p @ np.swapaxes(keep, -1, -2) + (
            gain * noises[..., None, :]
        ) @ np.swapaxes(gain, -1, -2)
        self._tip = np.where(use1[..., None], tip, self._tip)
        if covariance is not None:
            self._tip_covariance = np.where(use1[..., None, None], covariance, self._tip_covariance)
        self._since_pitch = np.where(use2, 0.0, since)

    def estimate(self) -> Estimate:
        """Return what is known now; see `Estimator.estimate`."""
        known = super().estimate()
        refused = tuple(f"pitch: {text}" for text in self._pitch_gate.warnings())
        return dataclasses.replace(known, warnings=known.warnings + refused)


def _variance(covariance: Array, row: Array) -> Array:
    return np.asarray(np.einsum("...i,...ij,...j->...", row, covariance, row))
