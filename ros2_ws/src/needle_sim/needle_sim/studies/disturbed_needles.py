"""Simulated needles under a study's disturbances: what moves them, and what is seen of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import (
    PATCH_LENGTH,
    BiasWalk,
    DelayLine,
    Disturbances,
    Insertion,
    bumps,
    measured,
    patch_factors,
    push_axes,
    roll_steps,
)
from needle_sim.studies.needle_batch import NeedleBatch


class DisturbedNeedles:
    """Some needles of a study.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    disturbances : Disturbances
        What goes wrong.
    curvature : float
        What the controller assumes [1/m].
    bump_at : float
        Insertion at which the phantom is moved, where that is a disturbance [m].
    seed, first : int
        Key the randomness: of the study, and the first needle.

    Attributes
    ----------
    true : NeedleBatch
        Where they really are.
    """

    def __init__(
        self,
        starts: FloatArray,
        disturbances: Disturbances,
        *,
        curvature: float,
        bump_at: float,
        seed: int,
        first: int,
    ) -> None:
        wrong = disturbances
        torsion = Torsion(wrong.play, wrong.lag_length) if wrong.play or wrong.lag_length else None
        self.true = NeedleBatch(starts, torsion)
        self._wrong = disturbances
        self._assumed = curvature * wrong.curvature_scale
        self._curvature = np.asarray(self._assumed)
        self._bump_at = bump_at
        self._key = seed, first
        self._count = len(starts)
        self._push = push_axes(wrong.push, seed, first, len(starts))
        self._bias = BiasWalk(wrong.bias_walk, seed, first, len(starts))
        self._patch = -1
        self._insertions = 0
        self._exposure = 0
        self._untold_delay = DelayLine(wrong.untold_delay)
        self._delay = DelayLine(wrong.delay)

    def first_seen(self) -> FloatArray:
        """Return what is measured of the tips before they move, (N, 3) [m]."""
        return self._measured()

    def insert(self, begin: float, end: float, length: ArrayLike, turned: FloatArray) -> None:
        """Move the stage on by a step, from one insertion to another.

        Parameters
        ----------
        begin, end : float
            Insertions of the stage, where every step is a whole one [m].
        length : array_like, shape (N,) or ()
            What each one's stage moves [m].
        turned : ndarray, shape (N,)
            What their bases turn [rad].
        """
        wrong, (seed, first) = self._wrong, self._key
        patch = int((begin + 1e-9) / PATCH_LENGTH)
        if wrong.curvature_patches and patch != self._patch:
            self._patch = patch
            factors = patch_factors(wrong.curvature_patches, seed, patch, first, self._count)
            self._curvature = np.asarray(self._assumed * factors)
        curvature, (factor, begins) = self._curvature, wrong.layer
        if begin + 1e-9 >= begins:
            curvature = curvature * factor
        inserted = np.broadcast_to(np.asarray(length) / (1.0 + wrong.slip), self._count)
        self._insertions += 1
        wandered: FloatArray = np.zeros(self._count)
        if wrong.roll_walk:
            wandered = roll_steps(wrong.roll_walk, seed, self._insertions, first, self._count)
            wandered *= np.sqrt(inserted)
        # Turning in space and turning with the tip commute: half of the push before, half after is
        # exact but for the place, which is off by less than 1 um at the end.
        half = 0.5 * inserted[:, np.newaxis] * self._push
        if wrong.push:
            self.true.turn(half)
        self.true.advance(inserted, wrong.rotation_gain * turned, curvature, wandered)
        if wrong.push:
            self.true.turn(half)
        if wrong.bump and begin < self._bump_at <= end:
            self.true.shift(bumps(wrong.bump, seed, first, self._count))

    def seen(self, insertion: Insertion) -> tuple[FloatArray, Insertion]:
        """Return what of the tips arrives after a step.

        Parameters
        ----------
        insertion : float, or ndarray, shape (N,)
            Of the stage [m].

        Returns
        -------
        tips : ndarray, shape (N, 3)
            [m]; NaN where nothing arrives.
        age : float, or ndarray, shape (N,)
            Insertion since they were measured, as the controller is told [m].
        """
        self._exposure += 1
        tips = self._measured()
        as_new, _ = self._untold_delay.pass_on(tips, insertion)
        return self._delay.pass_on(as_new, insertion)

    def _measured(self) -> FloatArray:
        seed, first = self._key
        tips = measured(self.true.tips, self._wrong, seed, self._exposure, first)
        return tips + self._bias.at(self._exposure) if self._wrong.bias_walk else tips
