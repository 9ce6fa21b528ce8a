"""A study: many simulated needles, each steered from its start to the depth by a controller."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from needle_sim.needle.se3 import FloatArray
from needle_sim.needle.tissue import Torsion
from needle_sim.studies.disturbances import (
    PATCH_LENGTH,
    DelayLine,
    Disturbances,
    measured,
    measured_pitch,
    patch_factors,
)
from needle_sim.studies.figures_of_merit import Outcomes, Tally, joined
from needle_sim.studies.needle_batch import NeedleBatch

CHUNK = 10_000
"""Needles steered at a time: their arrays fit into a processor's cache."""


class Controller(Protocol):
    """Controller of some needles; everything has their number as its leading axis.

    Attributes
    ----------
    measures_pitch : bool
        Whether the tips after the first have a fourth column, the measured pitch [rad].
    """

    measures_pitch: bool

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips, (N, 3) [m]; return the rotation rates, (N,) [rad/m]."""

    def step(
        self, d_insertion: float, d_rotation: FloatArray, tips: FloatArray, age: float
    ) -> FloatArray:
        """Take what happened in a step and what was measured after it.

        Parameters
        ----------
        d_insertion : float
            Insertion of the step [m].
        d_rotation : ndarray, shape (N,)
            What the bases turned [rad].
        tips : ndarray, shape (N, 3), or (N, 4) where the pitch is measured
            The measured tips [m]; NaN where missing.
        age : float
            Insertion since they were measured [m].

        Returns
        -------
        ndarray, shape (N,)
            Rotation of the base per inserted length over the next step [rad/m].
        """


@dataclasses.dataclass(frozen=True)
class StudySettings:
    """Common settings of every needle of a study.

    Attributes
    ----------
    curvature : float
        What the controller assumes, kappa [1/m]; `disturbances` say how far the plant is off.
    depth : float
        Insertion at the end [m].
    step_length : float
        Insertion between measurements [m]; the last step ends at the depth.
    disturbances : Disturbances
        What goes wrong.
    seed : int
        Of all randomness.
    """

    curvature: float
    depth: float
    step_length: float
    disturbances: Disturbances
    seed: int

    @property
    def steps(self) -> int:
        """Number of steps."""
        return max(1, math.ceil(self.depth / self.step_length - 1e-9))


def run_study(
    starts: FloatArray,
    new_controller: Callable[[], Controller],
    settings: StudySettings,
    *,
    on_progress: Callable[[int], None] = lambda _: None,
    chunk: int = CHUNK,
) -> Outcomes:
    """Steer each needle from its start.

    Parameters
    ----------
    starts : ndarray, shape (N, 3)
        x [m], pitch, roll [rad] of each needle.
    new_controller : callable
        Returns a controller for some needles.
    settings : StudySettings
        What the needles have in common.
    on_progress : callable
        Told after each step how many needles have made one.
    chunk : int
        Needles steered at a time; changes the time it takes, not the outcomes.

    Returns
    -------
    Outcomes
        In the order of the starts.
    """
    parts = []
    for first in range(0, len(starts), chunk):
        part = starts[first : first + chunk]
        parts.append(_steer(part, first, new_controller(), settings, on_progress))
    return joined(parts)


def _steer(
    starts: FloatArray,
    first: int,
    controller: Controller,
    settings: StudySettings,
    on_progress: Callable[[int], None],
) -> Outcomes:
    wrong, seed, steps = settings.disturbances, settings.seed, settings.steps
    torsion = Torsion(wrong.play, wrong.lag_length) if wrong.play or wrong.lag_length else None
    needles = NeedleBatch(starts, torsion)
    tally = Tally(needles.x, steps)
    delay = DelayLine(wrong.delay)
    rate = controller.start(measured(needles.tips, wrong, seed, 0, first))
    insertion = 0.0
    patch = -1
    curvature = np.asarray(settings.curvature * wrong.curvature_scale)
    for step in range(1, steps + 1):
        reached = min(step * settings.step_length, settings.depth)
        length, here = reached - insertion, int((insertion + 1e-9) / PATCH_LENGTH)
        if wrong.curvature_patches and here != patch:
            patch = here
            factors = patch_factors(wrong.curvature_patches, seed, patch, first, len(starts))
            curvature = np.asarray(settings.curvature * wrong.curvature_scale * factors)
        turned = rate * length
        needles.advance(length, turned, curvature)
        insertion = reached
        tally.add(needles.x, insertion, turned)
        on_progress(len(starts))
        if step < steps:
            seen = measured(needles.tips, wrong, seed, step, first)
            if controller.measures_pitch:
                pitch = measured_pitch(needles.pitch, wrong, seed, step, first)
                seen = np.column_stack([seen, pitch])
            rate = controller.step(length, turned, *delay.pass_on(seen, insertion))
    return tally.outcomes()
