"""A tracker on the virtual runner: measures the simulated needle, sends bytes as PLUS does."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from needle_core.component import Actions, Component, Moment, Port, Send, Timer
from needle_sim.bench import SimulatedBench
from plus_messages import transform_message

Array = NDArray[np.float64]
# Pose of the tracker in `rig`: about half a metre away, and turned.
TURN = Rotation.from_euler("xyz", (2.0, -0.4, 1.1))
PLACE = np.array([0.21, -0.33, 0.28])


@dataclasses.dataclass(frozen=True)
class TrackerModel:
    """Errors of a tracker.

    Attributes
    ----------
    rate : float
        Rate of the transforms [Hz].
    noise, heading_noise : float
        Standard deviation of a coordinate [m], and of the heading [rad].
    latency : float
        Time from the measurement to the arrival [s].
    lost : float
        Share of lost transforms.
    offset : float
        Distance from the sensor to the tip [m].
    is_late : bool
        Whether the stamp is the time of the arrival.
    """

    rate: float = 40.0
    noise: float = 0.3e-3
    heading_noise: float = 0.01
    latency: float = 0.2
    lost: float = 0.0
    offset: float = 0.0
    is_late: bool = False


class SimulatedTracker(Component):
    """Tracker with five degrees of freedom: the roll that it reports is arbitrary.

    Parameters
    ----------
    model : TrackerModel
        Its errors.
    seed : int
        Seed of the random errors.
    spoil : callable
        Changes a measurement (number of the transform, matrix in mm, stamp) into the bytes sent;
        by default they are those of PLUS.

    Attributes
    ----------
    bench : SimulatedBench
        The needle, to be set before the run.
    truth : dict of int to ndarray
        True pose of the tip, (4, 4), by the time of its measurement [ns].
    """

    name = "simulated_tracker"
    bench: SimulatedBench

    def __init__(
        self,
        model: TrackerModel,
        seed: int,
        spoil: Callable[[int, Array, float], bytes] = lambda _, matrix, stamp: transform_message(
            matrix, stamp
        ),
    ) -> None:
        self.model, self._spoil = model, spoil
        self._random = np.random.default_rng([seed, 77])
        self.truth: dict[int, Array] = {}
        self._queue: list[tuple[float, bytes]] = []
        self._number = 0
        self.ports = (Port("tracker", self._ignore),)
        self.timers = (Timer(1.0 / model.rate, self._measure), Timer(0.002, self._deliver))

    def _ignore(self, batch: Sequence[Any], at: Moment) -> Actions:
        return ()

    def _measure(self, at: Moment) -> Actions:
        model, random = self.model, self._random
        pose = self.bench.plant.T_rig_tip
        self.truth[at.stamp_ns] = pose.copy()
        tilt = Rotation.from_rotvec([*random.normal(0.0, model.heading_noise, 2), 0.0])
        roll = Rotation.from_euler("z", random.uniform(-np.pi, np.pi))
        turn = Rotation.from_matrix(pose[:3, :3]) * tilt * roll
        sensor = pose[:3, 3] - turn.apply([0.0, 0.0, model.offset])
        matrix = np.eye(4)
        matrix[:3, :3] = (TURN.inv() * turn).as_matrix()
        noise = random.normal(0.0, model.noise, 3)
        matrix[:3, 3] = 1e3 * (TURN.inv().apply(sensor - PLACE) + noise)
        if random.random() >= model.lost:
            stamp = at.stamp_ns * 1e-9 + (model.latency if model.is_late else 0.0)
            data = self._spoil(self._number, matrix, stamp)
            self._queue.append((at.steady + model.latency, data))
        self._number += 1
        return ()

    def _deliver(self, at: Moment) -> Actions:
        while self._queue and self._queue[0][0] <= at.steady:
            yield Send("tracker", (self._queue.pop(0)[1],))
