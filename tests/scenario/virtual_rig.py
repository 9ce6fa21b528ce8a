"""Driver and emulated drives on a virtual clock, with other components and nodes beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from needle_core import messages as m
from needle_core.component import (
    BEST_EFFORT,
    LATCHED,
    Action,
    Actions,
    Component,
    Input,
    Moment,
    Output,
    Publish,
    Timer,
)
from needle_core.runners.transport import Fault
from needle_core.status_messages import ControllerStatus, DeviceStatus
from needle_device_driver.conformance.rig import ConformanceRig, RigClient
from needle_device_driver.rules import Rule
from needle_sim.drives.emulated_bus import EmulatedBus

HOLD = Output("device/hold", m.HoldState, BEST_EFFORT)
COMMANDS = Output("device/joint_trajectory", m.Trajectory)
ESTOP = Output("device/estop", m.EmergencyStop)
STATUS = Output("device/status", DeviceStatus, LATCHED)


class VirtualRigClient(RigClient):
    """Also keeps the controller's status."""

    def __init__(self, *, steers: bool) -> None:
        super().__init__(steers=steers)
        self.controller = ControllerStatus()
        row = Input("needle/controller_status", ControllerStatus, self._on_controller, LATCHED)
        self.inputs = (*self.inputs, row)

    def _on_controller(self, message: ControllerStatus, _: Moment) -> Actions:
        self.controller = message
        return ()


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
    """Drives, driver, client and other components; a controller among them sends the commands."""

    hand: VirtualRigClient

    def __init__(
        self,
        seed: int,
        *others: Component,
        driver: Mapping[str, Any] | None = None,
        drives: Mapping[str, Any] | None = None,
        faults: Sequence[Fault] = (),
    ) -> None:
        hand = VirtualRigClient(steers=not others)
        super().__init__(seed, *others, hand=hand, driver=driver, drives=drives, faults=faults)

    @property
    def bus(self) -> EmulatedBus:
        """CAN bus with the CiA 402 drives."""
        bus: EmulatedBus = self.drives.bus
        return bus

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
