"""The bench: a needle moved only by the motors, and the measurements of a tracker."""

from __future__ import annotations

import dataclasses
import enum
import math
import random
from collections.abc import Callable

import numpy as np

from needle_core import messages as m
from needle_core.component import Action, Actions, Component, Moment, Output, Publish, Timer
from needle_sim.drives.emulated_bus import EmulatedBus
from needle_sim.needle.plant import NeedlePlant, initial_pose
from needle_sim.needle.tissue import Torsion

TICK = 0.01
"""Period of the observation of the motors [s]."""
_FRAME_RATE = 20.0
ANSWER = (0.015, 0.045)
"""Shortest and longest time from exposure to answer [s]."""
TIP_NOISE = 0.0002
"""Half width of the noise of a coordinate [m]."""
_LATEST_ANSWER = 3.0
_CURVATURE = 1.0 / 0.122
# Largest pieces in which the needle follows the motors [m], [rad].
_PIECE = 0.0002, 0.1
# A tip alone contains no information on the heading [rad^2].
_UNKNOWN_ORIENTATION = 1e6
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Motors:
    """True positions of both motors [m], [rad]."""

    insertion: float = 0.0
    rotation: float = 0.0


class Bench(Component):
    """Lets the needle follow the motors.

    Parameters
    ----------
    bus : EmulatedBus
        The drives.
    chance : Random
        Draws the needle.

    Attributes
    ----------
    motors : Motors
        Positions at the last tick.
    watchers : list of callable
        Called with the time [s] and the motors at every tick.
    deepest_tip : ndarray, shape (3,)
        True tip at the largest insertion, in `rig` [m].
    """

    name = "bench"

    def __init__(self, bus: EmulatedBus, chance: random.Random) -> None:
        draw = chance.uniform
        self._bus = bus
        self._plant = NeedlePlant(
            initial_pose(draw(-0.1, 0.1), draw(-0.5, 0.5)),
            curvature=_CURVATURE * draw(0.9, 1.1),
            torsion=Torsion(play=draw(0.0, 0.3), lag_length=0.0),
        )
        self.motors = self._taken = Motors()
        self._deepest = 0.0
        self.deepest_tip = self.tip
        self.watchers: list[Callable[[float, Motors], None]] = []
        self.timers = (Timer(TICK, self._tick),)

    @property
    def tip(self) -> np.ndarray:
        """The true tip in `rig`, shape (3,) [m]."""
        self._follow_motors()
        return self._plant.T_rig_tip[:3, 3]

    def _tick(self, at: Moment) -> Actions:
        axes = self._bus.axes(at.steady)
        self.motors = Motors(axes["insertion"].position, axes["rotation"].position)
        if any(abs(step) > piece for step, piece in zip(self._travel, _PIECE, strict=True)):
            self._follow_motors()
        for watch in self.watchers:
            watch(at.steady, self.motors)
        return ()

    @property
    def _travel(self) -> tuple[float, float]:
        """Motion of the motors since the needle followed them [m], [rad]."""
        at, taken = self.motors, self._taken
        return at.insertion - taken.insertion, at.rotation - taken.rotation

    def _follow_motors(self) -> None:
        if any(self._travel):
            self._plant.advance(*self._travel)
        self._taken = self.motors
        if self.motors.insertion > self._deepest:
            self._deepest = self.motors.insertion
            self.deepest_tip = self._plant.T_rig_tip[:3, 3]


class CameraState(enum.Enum):
    """States of the cameras."""

    CLEAR = "clear"
    BLACK = "black"
    FROZEN = "frozen"
    WRONG = "wrong"
    LATE = "late"


class TrackerStandIn(Component):
    """Replaces the tracker: publishes the tip of every exposure.

    Parameters
    ----------
    bench : Bench
        Rig with the needle.
    chance : Random
        Draws noise and wrong tips.

    Attributes
    ----------
    camera_state : CameraState
        State of the cameras.
    """

    name = "stereo_tracker"

    def __init__(self, bench: Bench, chance: random.Random) -> None:
        self._bench, self._chance = bench, chance
        self.camera_state = CameraState.CLEAR
        self._last = bench.tip
        # Answers with their due times [s].
        self._answers: list[tuple[float, list[Action]]] = []
        self.outputs = (
            Output("needle/tip", m.Point),
            Output("needle/tip_pose", m.PoseWithCovariance),
        )
        self.timers = (Timer(1.0 / _FRAME_RATE, self._expose),)

    def _expose(self, at: Moment) -> Actions:
        draw = self._chance.uniform
        noise = [draw(-TIP_NOISE, TIP_NOISE) for _ in range(3)]
        wrong = [draw(-0.02, 0.02) for _ in range(3)]
        late = draw(0.0, _LATEST_ANSWER)
        if self.camera_state is not CameraState.FROZEN:
            self._last = self._bench.tip + noise
        measured = self._last + wrong if self.camera_state is CameraState.WRONG else self._last
        due = at.steady + (late if self.camera_state is CameraState.LATE else 0.0)
        self._answers.append((due, list(self._answer(measured, at.stamp_ns))))
        for answer in [one for one in self._answers if one[0] <= at.steady]:
            self._answers.remove(answer)
            yield from answer[1]

    def _answer(self, measured: np.ndarray, stamp_ns: int) -> Actions:
        x, y, z = measured.tolist()
        found = self.camera_state is not CameraState.BLACK
        covariance = [0.0] * 36
        variance = TIP_NOISE**2 / 3.0 if found else math.inf
        covariance[::7] = [variance] * 3 + [_UNKNOWN_ORIENTATION] * 3
        yield Publish(
            "needle/tip_pose",
            m.PoseWithCovariance(stamp_ns, "rig", (x, y, z), _UPRIGHT, tuple(covariance)),
        )
        if found:
            yield Publish("needle/tip", m.Point(stamp_ns, "rig", (x, y, z)))
