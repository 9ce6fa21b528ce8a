"""Foreign nodes that publish on topics of the rig, well formed or not."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

from needle_core import component as c
from needle_core import messages as m
from scenario.faults import FLOOD, Fault, Kind, rogue_topic
from scenario.parts.bench import Bench

_PERIOD = 0.05
# Period of a flood [s], and messages in each period.
_FLOOD_PERIOD, _AT_ONCE = 0.001, 5
_JOINTS = (m.INSERTION_JOINT, m.ROTATION_JOINT)


class RoguePublisher(c.Component):
    """Publishes on one topic from its start.

    Parameters
    ----------
    name : str
        Name of the node.
    fault : Fault
        Gives the topic, the rate and whether messages are well formed.
    bench : Bench
        Rig that it imitates.
    chance : Random
        Draws its messages.
    """

    def __init__(self, name: str, fault: Fault, bench: Bench, chance: random.Random) -> None:
        self.name = name
        self._garbage = fault.kind is Kind.GARBAGE
        self._bench, self._chance = bench, chance
        self._topic = rogue_topic(fault).removeprefix("/")
        rows: dict[str, tuple[type[Any], Any, Callable[[int], Any]]] = {
            "device/hold": (m.HoldState, c.BEST_EFFORT, self._hold),
            "device/joint_trajectory": (m.Trajectory, c.RELIABLE, self._trajectory),
            "device/estop": (m.EmergencyStop, c.RELIABLE, lambda _: m.EmergencyStop(True)),
            "joint_states": (m.JointState, c.RELIABLE, self._joints),
            "needle/tip": (m.Point, c.RELIABLE, self._tip),
            "target_plane": (m.Pose, c.LATCHED, self._plane),
        }
        kind, delivery, self._make = rows[self._topic]
        self.outputs = (c.Output(self._topic, kind, delivery),)
        floods = fault.part == FLOOD
        self._at_once = _AT_ONCE if floods else 1
        self.timers = (c.Timer(_FLOOD_PERIOD if floods else _PERIOD, self._act),)

    def on_stop(self, at: c.Moment) -> c.Actions:
        """Release an emergency stop, and exit."""
        if self._topic == "device/estop":
            yield c.Publish(self._topic, m.EmergencyStop(False))
        yield c.Exit(0)

    def _act(self, at: c.Moment) -> c.Actions:
        for _ in range(self._at_once):
            yield c.Publish(self._topic, self._make(at.stamp_ns))

    def _number(self, value: float) -> float:
        return self._chance.choice((math.nan, math.inf, -1e300)) if self._garbage else value

    def _hold(self, stamp_ns: int) -> m.HoldState:
        # No session, as from `ros2 topic pub`: otherwise a first press does not count.
        return m.HoldState("stranger", "", stamp_ns, True, self._number(1.0), m.HOLD_LIFETIME)

    def _trajectory(self, stamp_ns: int) -> m.Trajectory:
        at = self._bench.motors
        place = (self._number(at.insertion + 0.001), at.rotation)
        return m.Trajectory(stamp_ns, _JOINTS, (m.TrajectoryPoint(place, 0.5),))

    def _joints(self, stamp_ns: int) -> m.JointState:
        draw = self._chance.uniform
        return m.JointState(stamp_ns, _JOINTS, (self._number(draw(0.0, 0.1)), draw(-1.0, 1.0)))

    def _tip(self, stamp_ns: int) -> m.Point:
        x = self._number(self._chance.uniform(-0.003, 0.003))
        return m.Point(stamp_ns, "rig", (x, 0.0, self._bench.motors.insertion))

    def _plane(self, stamp_ns: int) -> m.Pose:
        x = self._number(self._chance.uniform(-0.002, 0.002))
        return m.Pose(stamp_ns, "rig", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
