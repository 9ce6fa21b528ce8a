"""Driver and emulated drives on a virtual clock, with other components beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from needle_core import messages as m
from needle_core.component import LATCHED, Actions, Component, Input, Moment
from needle_core.runners.transport import Fault
from needle_core.status_messages import ControllerStatus
from needle_device_driver.conformance.rig import ConformanceRig, RigClient
from needle_sim.drive_emulator import POSITIONS


class VirtualRigClient(RigClient):
    """Also keeps the controller's status and the positions of the drives.

    Attributes
    ----------
    places : list of tuple of float
        Positions of the drives.
    received : Counter of str
        Number of received messages by topic.
    """

    def __init__(self, *, steers: bool) -> None:
        super().__init__(steers=steers)
        self.controller = ControllerStatus()
        self.places: list[tuple[float, float]] = []
        self.received: Counter[str] = Counter()
        self.inputs = (
            *self.inputs,
            Input("needle/controller_status", ControllerStatus, self._on_controller, LATCHED),
            Input(POSITIONS, m.JointState, self._on_positions),
        )

    def _on_controller(self, message: ControllerStatus, _: Moment) -> Actions:
        self.controller = message
        return ()

    def _on_joints(self, message: m.JointState, at: Moment) -> Actions:
        self.received["joint_states"] += 1
        return super()._on_joints(message, at)

    def _on_positions(self, message: m.JointState, at: Moment) -> Actions:
        self.received[POSITIONS] += 1
        self.places.append((message.positions[0], message.positions[1]))
        return ()


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
        self.bus = self.drives.bus
