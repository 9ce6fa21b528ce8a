"""The controllers a study can ask for: needle_controller's own estimators and laws, unchanged.

This is the only module of needle_sim that knows the controller under test.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from needle_common.errors import UserError
from needle_controller.laws.law import StepLaw
from needle_controller.observers.estimator import Estimator
from needle_controller.observers.pitch_observer import PitchObserver
from needle_controller.presets.control_settings import PRESETS, ControlSettings
from needle_controller.presets.presets import make_controller
from needle_sim.needle.se3 import FloatArray

CURVATURE = ControlSettings.curvature
STEP_LENGTH = ControlSettings.step_length
# A sensor without noise still has this bound for the controllers' design [m].
_SMALLEST_NOISE = 1e-5


class SteeredNeedles:
    """An estimator and a law, called as the node calls them: what `study.Controller` describes.

    Parameters
    ----------
    estimator : Estimator
        For as many needles as there will be tips.
    law : callable
        Returns the command for an estimate at an inserted length [m].
    """

    def __init__(self, estimator: Estimator, law: StepLaw) -> None:
        self._estimator = estimator
        self._law = law
        self._insertion = 0.0
        self.measures_pitch = isinstance(estimator, PitchObserver)

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips; see `study.Controller.start`."""
        self._estimator.reset(tips, np.zeros((len(tips), 2)))
        return self._rate()

    def step(
        self, d_insertion: float, d_rotation: FloatArray, tips: FloatArray, age: float
    ) -> FloatArray:
        """Take a step and what was measured after it; see `study.Controller.step`."""
        self._insertion += d_insertion
        self._estimator.advance(d_insertion, d_rotation)
        if isinstance(self._estimator, PitchObserver):
            self._estimator.correct(tips[:, :3], age=age, pitch=tips[:, 3])
        else:
            self._estimator.correct(tips, age=age)
        return self._rate()

    def _rate(self) -> FloatArray:
        return self._law(self._estimator.estimate(), self._insertion).rotation_rate


def controller_factory(
    name: str, noise: float, flip_depths: Sequence[float] = ()
) -> Callable[[], SteeredNeedles]:
    """Return what makes the controller of some needles.

    Parameters
    ----------
    name : str
        One of `PRESETS`.
    noise : float
        Largest error of a measured coordinate that the sensor is known to make [m].
    flip_depths : sequence of float
        Insertions at which the bevel is flipped, mirrored, in rising order [m].

    Raises
    ------
    UserError
        If there is no such controller, or it cannot flip.
    """
    if name not in PRESETS:
        raise UserError(f"--controller {name!r} is not available; there is {', '.join(PRESETS)}")
    noise = max(noise, _SMALLEST_NOISE)
    settings = dataclasses.replace(
        ControlSettings(),
        preset=name,
        tip_noise_bound=noise,
        measurement_std=noise / math.sqrt(3.0),
        flip_depths=tuple(flip_depths),
    )
    make_controller(settings, np.eye(3))
    return lambda: SteeredNeedles(*make_controller(settings, np.eye(3)))
