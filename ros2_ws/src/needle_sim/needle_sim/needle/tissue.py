"""Torsion of the needle in tissue."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray


class Torsion:
    """Torsion of the shaft between base and tip: play, then a lag in inserted length.

    [KC09] neglects torsional compliance and names friction along the shaft as the likely cause of
    its "sluggish response"; this is the simplest model of it. Play: the tip angle is constant until
    the base is `play` ahead of it, then it follows at that distance. Lag: the output of the play
    reaches the tip over the inserted length, d(tip)/dl = (input - tip) / lag_length; without
    insertion the tip does not rotate. Both are integrated exactly for a base rotation proportional
    to the insertion within a call, so that splitting a call changes nothing.

    Parameters
    ----------
    play : array_like, shape (...)
        Half width of the dead band [rad]; 0: no play.
    lag_length : array_like, shape (...)
        Inserted length over which the difference falls to 1/e [m]; 0: no lag.

    Raises
    ------
    ValueError
        If one of them is negative or not finite.
    """

    def __init__(self, play: ArrayLike = 0.0, lag_length: ArrayLike = 0.0) -> None:
        self._play = _not_negative("play", play)
        self._lag_length = _not_negative("lag_length", lag_length)
        self._base: FloatArray = np.zeros(())
        self._play_output: FloatArray = np.zeros(())
        self._tip: FloatArray = np.zeros(())

    @property
    def behind_play(self) -> FloatArray:
        """Output of the play so far [rad], shape (...)."""
        return self._play_output

    @property
    def tip_angle(self) -> FloatArray:
        """Rotation of the tip so far [rad], shape (...)."""
        return self._tip

    def advance(self, d_insertion: ArrayLike, d_rotation: ArrayLike) -> FloatArray:
        """Rotate the base while the needle moves, and return the rotation of the tip.

        Parameters
        ----------
        d_insertion : array_like, shape (...)
            Length moved [m]; only its absolute value matters, as the shaft rubs in both directions.
        d_rotation : array_like, shape (...)
            Rotation of the base over that length [rad].

        Returns
        -------
        ndarray, shape (...)
            Rotation of the tip [rad].
        """
        length = np.abs(np.asarray(d_insertion, dtype=np.float64))
        turned = np.asarray(d_rotation, dtype=np.float64)
        self._base = self._base + turned
        input_before = self._play_output
        self._play_output = np.clip(input_before, self._base - self._play, self._base + self._play)
        if not np.any(self._lag_length):
            tip = self._play_output
        else:
            tip = self._lagged_tip(length, turned, input_before)
        tip_turned = np.asarray(tip - self._tip)
        self._tip = np.asarray(tip)
        return tip_turned

    def _lagged_tip(
        self, length: FloatArray, turned: FloatArray, input_before: FloatArray
    ) -> FloatArray:
        """Integrate the lag exactly: first the part in which the play closes, then the ramp."""
        change = self._play_output - input_before
        share = np.where(turned == 0.0, 0.0, change / np.where(turned == 0.0, 1.0, turned))
        lag_length = np.where(self._lag_length > 0.0, self._lag_length, 1.0)
        still = length * (1.0 - share) / lag_length
        ramp = length * share / lag_length
        tip = input_before + (self._tip - input_before) * np.exp(-(still + ramp))
        # Mean of exp(-l / lag_length) over the ramp: 1 for a rotation without insertion.
        mean_decay = np.where(ramp > 0.0, -np.expm1(-ramp) / np.where(ramp > 0.0, ramp, 1.0), 1.0)
        tip = tip + change * (1.0 - mean_decay)
        return np.where(self._lag_length > 0.0, tip, self._play_output)


def _not_negative(name: str, value: ArrayLike) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if not np.all((array >= 0.0) & np.isfinite(array)):
        raise ValueError(f"{name} = {value!r} must be finite and not negative")
    return array
