"""Sensors of the simulated rig: the messages that result from an exposure of the needle."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from needle_core import messages as m
from needle_core.component import Actions, Output, Port, Publish
from needle_sim.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

RIG = "rig"
# Variance of the undetermined orientation [rad^2].
_UNKNOWN_ORIENTATION = 1e6
# A variance of 0 would mean "unknown" [m^2].
_MIN_POSITION_VARIANCE = 1e-12
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# Random stream of the tip noise; streams 0 and 1 belong to the left and the right image.
_STREAM = 4


class Sensor(Protocol):
    """Sensor that measures the needle.

    Attributes
    ----------
    outputs : tuple of Output
        Topics that it publishes.
    ports : tuple of Port
        Ports that it uses.
    half_sizes : tuple of float
        Distance from the needle axis to the phantom's faces, along x and y [m].
    """

    outputs: tuple[Output, ...]
    ports: tuple[Port, ...]
    half_sizes: tuple[float, float]

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the messages of an exposure."""


class TipSensor:
    """Sensor of level `tip`: the tip with the uniform noise of [KC09] section IV.

    Parameters
    ----------
    bench : SimulatedBench
        Needle that is measured.
    settings : SimRigParameters
        Parameters of the rig.
    """

    half_sizes = (math.inf, math.inf)
    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        self._noise, self._seed = settings.tip_noise, settings.seed
        self.outputs: tuple[Output, ...] = (
            Output("needle/tip_pose", m.PoseWithCovariance),
            Output("needle/tip", m.Point),
        )

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the measured tip, first with its covariance."""
        rng = np.random.default_rng([self._seed, number, _STREAM])
        x, y, z = (self._bench.tip + rng.uniform(-self._noise, self._noise, 3)).tolist()
        variance = max(self._noise**2 / 3.0, _MIN_POSITION_VARIANCE)
        covariance = [0.0] * 36
        covariance[::7] = [variance] * 3 + [_UNKNOWN_ORIENTATION] * 3
        pose = m.PoseWithCovariance(stamp_ns, RIG, (x, y, z), _UPRIGHT, tuple(covariance))
        yield Publish("needle/tip_pose", pose)
        yield Publish("needle/tip", m.Point(stamp_ns, RIG, (x, y, z)))


def make_sensor(bench: SimulatedBench, settings: SimRigParameters) -> Sensor:
    """Return the sensor of the level that the settings name."""
    if settings.level == "tip":
        return TipSensor(bench, settings)
    # Loading the renderer takes a long time, and level tip does not need it.
    from needle_sim.cameras import CameraSensor  # noqa: PLC0415

    return CameraSensor(bench, settings)
