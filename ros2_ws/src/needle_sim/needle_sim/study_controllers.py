"""The controllers a study can ask for: needle_controller's own estimators and laws, unchanged.

This is the only module of needle_sim that knows the controller under test.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from needle_common.errors import UserError
from needle_controller.estimator import Estimator
from needle_controller.law import Law
from needle_controller.luenberger import LuenbergerObserver
from needle_controller.plane_control import ControlSettings, make_law, observer_settings
from needle_sim.se3 import FloatArray

CONTROLLERS = ("paper", "open_loop")
LATER_CONTROLLERS = ("best",)
CURVATURE = ControlSettings.curvature
STEP_LENGTH = ControlSettings.step_length
# A sensor without noise still has this standard deviation for the gains' design [m].
_SMALLEST_STD = 1e-5


class SteeredNeedles:
    """An estimator and a law, called as the node calls them: what `study.Controller` describes."""

    def __init__(self, estimator: Estimator, law: Law) -> None:
        self._estimator = estimator
        self._law = law

    def start(self, tips: FloatArray) -> FloatArray:
        """Take the first measured tips; see `study.Controller.start`."""
        self._estimator.reset(tips, np.zeros((len(tips), 2)))
        return self._law(self._estimator.estimate()).rotation_rate

    def step(
        self, d_insertion: float, d_rotation: FloatArray, tips: FloatArray, age: float
    ) -> FloatArray:
        """Take a step and what was measured after it; see `study.Controller.step`."""
        self._estimator.advance(d_insertion, d_rotation)
        self._estimator.correct(tips, age=age)
        return self._law(self._estimator.estimate()).rotation_rate


def controller_factory(name: str, noise: float, flips: int = 0) -> Callable[[], SteeredNeedles]:
    """Return what makes the controller of some needles.

    Parameters
    ----------
    name : str
        One of `CONTROLLERS`.
    noise : float
        Largest error of a measured coordinate that the sensor is known to make [m].
    flips : int
        How often the bevel is flipped on the way.

    Raises
    ------
    UserError
        If there is no such controller, or it cannot flip.
    """
    if name in LATER_CONTROLLERS:
        raise UserError(f"--controller {name} is not available; there is {', '.join(CONTROLLERS)}")
    if name not in CONTROLLERS:
        raise UserError(f"--controller {name!r} is not one of {', '.join(CONTROLLERS)}")
    if flips:
        raise UserError(f"--flips {flips}: {name} cannot steer with the bevel flipped")
    std = max(noise / math.sqrt(3.0), _SMALLEST_STD)
    settings = dataclasses.replace(ControlSettings(), preset=name, measurement_std=std)
    gains = settings.gains()

    def build() -> SteeredNeedles:
        observer = LuenbergerObserver(observer_settings(settings, gains))
        return SteeredNeedles(observer, make_law(settings, gains))

    return build
