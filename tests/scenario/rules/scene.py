"""A scene for one safety rule: driver, emulated drives, a client, and other nodes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Action,
    Actions,
    Component,
    Moment,
    Output,
    Publish,
    Timer,
)
from needle_core.status_messages import DeviceStatus
from needle_device_driver.conformance.rig import AXES, DRIVER, Held
from needle_device_driver.rules import Rule
from scenario.virtual_rig import VirtualRig

JOINTS = (m.INSERTION_JOINT, m.ROTATION_JOINT)


class SecondNode(Component):
    """A second node that publishes on topics of the rig.

    Parameters
    ----------
    *outputs : Output
        Its topics.
    """

    name = "other"

    def __init__(self, *outputs: Output) -> None:
        self.actions: list[Action] = []
        self.outputs = outputs
        self.timers = (Timer(0.01, self._act),)

    def _act(self, at: Moment) -> Actions:
        yield from self.actions
        self.actions = []


HOLD = Output("device/hold", m.HoldState, BEST_EFFORT)
COMMANDS = Output("device/joint_trajectory", m.Trajectory)
ESTOP = Output("device/estop", m.EmergencyStop)
STATUS = Output("device/status", DeviceStatus, LATCHED)


class Scene(VirtualRig):
    """The rig, ready to be homed.

    Parameters
    ----------
    driver, drives : mapping, optional
        Parameters of driver and drives.
    """

    def __init__(
        self,
        driver: Mapping[str, Any] | None = None,
        drives: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(1, driver=driver, drives=drives)

    # ---- actions ------------------------------------------------------------------------------

    def send(
        self,
        *points: tuple[tuple[float, ...], float],
        age: float = 0.0,
        stamp: int | None = None,
    ) -> int:
        """Send a command with these points and times, and a stamp [ns] or an age [s]."""
        if stamp is None:
            stamp = self.runner.timeline.stamp_ns - round(age * 1e9)
        way = tuple(m.TrajectoryPoint(place, time) for place, time in points)
        self.hand.actions.append(Publish(COMMANDS.topic, m.Trajectory(stamp, JOINTS, way)))
        self.runner.run(0.1)
        return stamp

    def until_done(self, stamp: int) -> None:
        """Run until a step ends."""
        self.until(lambda: stamp in self.hand.results, "the result of a step")

    def start_node(self, *outputs: Output) -> SecondNode:
        """Start another node, and run until others have discovered it."""
        other = SecondNode(*outputs)
        self.runner.start(other)
        self.runner.run(0.3)
        return other

    def act(self, other: SecondNode, *actions: Action) -> None:
        """Let the other node act, and run 0.1 s."""
        other.actions += actions
        self.runner.run(0.1)

    def silence(self, seconds: float) -> None:
        """Freeze the client, as a hanging process."""
        self.runner.freeze(self.hand.name, seconds)
        self.runner.run(seconds)

    # ---- observations -------------------------------------------------------------------------

    def refuses(self, rule: Rule) -> bool:
        """Return whether the last command was rejected by a rule, and nothing moves."""
        return self.is_at_rest() and self.is_logged(rule) and self.state != "MOVING"


__all__ = ["AXES", "COMMANDS", "DRIVER", "ESTOP", "HOLD", "STATUS", "Held", "Scene", "SecondNode"]
