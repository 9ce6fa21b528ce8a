"""Driver, emulated drives and other nodes on a virtual clock."""

from __future__ import annotations

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
from needle_device_driver.conformance.rig import ConformanceRig
from needle_device_driver.rules import Rule

HOLD = Output("device/hold", m.HoldState, BEST_EFFORT)
COMMANDS = Output("device/joint_trajectory", m.Trajectory)
ESTOP = Output("device/estop", m.EmergencyStop)
STATUS = Output("device/status", DeviceStatus, LATCHED)


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


class VirtualRig(ConformanceRig):
    """Drives, driver and client; other nodes can be added."""

    def send(self, insertion: float, stamp_ns: int) -> None:
        """Send a step to a position [m] for the tip of a stamp [ns]."""
        points = (m.TrajectoryPoint((insertion, 0.0), 0.5),)
        joints = (m.INSERTION_JOINT, m.ROTATION_JOINT)
        self.hand.actions.append(Publish(COMMANDS.topic, m.Trajectory(stamp_ns, joints, points)))
        self.runner.run(0.1)

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
        """Execute actions of the other node, and run for 0.1 s."""
        other.actions += actions
        self.runner.run(0.1)

    def refuses(self, rule: Rule) -> bool:
        """Return whether the last command was rejected by a rule, and nothing moves."""
        return self.is_at_rest() and self.is_logged(rule) and self.state != "MOVING"
