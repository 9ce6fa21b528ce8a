"""Sensors of the simulated rig: what an exposure of the needle sends."""

from __future__ import annotations

import math
from typing import Protocol

from needle_core import messages as m
from needle_core.component import Actions, Output, Port, Publish
from needle_sim.rig.bench import SimulatedBench
from needle_sim.sim_rig_parameters import SimRigParameters

RIG = "rig"
# A tip alone says nothing about the heading [rad^2].
_UNKNOWN_ORIENTATION = 1e6
# A variance of 0 would read as "not known" [m^2].
_LEAST_POSITION_VARIANCE = 1e-12
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class Sensor(Protocol):
    """A sensor that sees the needle.

    Attributes
    ----------
    outputs : tuple of Output
        What it sends.
    ports : tuple of Port
        What it is wired to.
    half_sizes : tuple of float
        Ends of the phantom, either way, along x and y [m].
    """

    outputs: tuple[Output, ...]
    ports: tuple[Port, ...]
    half_sizes: tuple[float, float]

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the messages of an exposure."""

    def close(self) -> None:
        """Complete what it writes."""


class TipSensor:
    """Level `tip`: the tip with uniform noise.

    Parameters
    ----------
    bench : SimulatedBench
        What is measured.
    settings : SimRigParameters
        The rig's.
    """

    half_sizes = (math.inf, math.inf)
    ports: tuple[Port, ...] = ()

    def __init__(self, bench: SimulatedBench, settings: SimRigParameters) -> None:
        self._bench = bench
        self._noise = settings.tip_noise
        self.outputs: tuple[Output, ...] = (
            Output("needle/tip_pose", m.PoseWithCovariance),
            Output("needle/tip", m.Point),
        )

    def expose(self, number: int, stamp_ns: int) -> Actions:
        """Return the measured tip, with its covariance first."""
        x, y, z = (float(c) for c in self._bench.measure_tip(number))
        variance = max(self._noise**2 / 3.0, _LEAST_POSITION_VARIANCE)
        covariance = [0.0] * 36
        covariance[::7] = [variance] * 3 + [_UNKNOWN_ORIENTATION] * 3
        pose = m.PoseWithCovariance(stamp_ns, RIG, (x, y, z), _UPRIGHT, tuple(covariance))
        yield Publish("needle/tip_pose", pose)
        yield Publish("needle/tip", m.Point(stamp_ns, RIG, (x, y, z)))

    def close(self) -> None:
        """Do nothing: nothing is open."""


def make_sensor(bench: SimulatedBench, settings: SimRigParameters) -> Sensor:
    """Return the sensor of a level."""
    if settings.level == "tip":
        return TipSensor(bench, settings)
    # The renderer takes longer to load than all else: not where nothing is drawn.
    from needle_sim.camera_sensor import CameraSensor  # noqa: PLC0415

    return CameraSensor(bench, settings)
