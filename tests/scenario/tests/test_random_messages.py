"""Random messages of other nodes: no component fails, and no motor turns without a hold."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import pytest

from needle_bringup.operator.component import Operator
from needle_bringup.operator.parameters import OperatorParameters
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_rig
from needle_console.console import Console
from needle_console.console_parameters import ConsoleParameters
from needle_core import convert
from needle_core.component import Actions, Call, Component, Moment, Output, Publish, Timer
from needle_core.message_types import rclpy_types
from needle_core.runners.virtual import LOG, VirtualRunner
from random_messages import random_message

PERIOD = 0.002
SECONDS = 10.0


class Careless(Component):
    """Publishes and calls at random everything that the others receive and offer, except holds."""

    name = "careless"

    def __init__(self, others: list[Component], chance: random.Random) -> None:
        rows = {row.topic: row for other in others for row in other.inputs}
        # A random press is a valid press, a rig has one device, and the motor positions belong to
        # the simulation.
        for left_out in ("device/hold", "joy", "device/status", "sim/drive_positions"):
            rows.pop(left_out, None)
        self.outputs = [Output(row.topic, row.message, row.delivery) for row in rows.values()]
        # A random confirmation that the needle is out may be valid.
        self._offered = [
            service
            for other in others
            for service in other.services
            if "confirm" not in service.name
        ]
        self.timers = (Timer(PERIOD, self._act),)
        self._chance, self._types = chance, rclpy_types()
        self.published: set[str] = set()

    def _act(self, at: Moment) -> Actions:
        row = self._chance.choice(self.outputs)
        kind = self._types.make(convert.ros_type(row.message))
        try:
            message = convert.from_ros(row.message, random_message(kind, self._chance))
        except ValueError:
            # A node rejects it before its component receives it.
            return
        self.published.add(row.topic)
        yield Publish(row.topic, message)
        if self._chance.random() < 0.01:
            service = self._chance.choice(self._offered)
            argument = self._chance.random() < 0.5 if service.has_argument else None
            yield Call(service.name, argument)


@pytest.mark.parametrize("level", ["drive", "camera"])
def test_random_messages_neither_fail_nor_move_a_rig(level: str) -> None:
    parameters = command_line_parameters(parse(["--level", level]), Path())
    parts = [
        *make_rig(parameters),
        Operator(OperatorParameters(source="joy", key=0, retract_key=1, stop_key=2)),
        Console(ConsoleParameters()),
    ]
    careless = Careless(parts, random.Random(level))
    failures: list[str] = []
    depths: set[float] = set()

    def watch(_: int, sender: str, message: Any, output: Output) -> None:
        if output is LOG and "internal error" in message.text:
            failures.append(f"{sender}: {message.text}")
        if output.topic == "sim/tip_pose":
            depths.add(message.position[2])

    runner = VirtualRunner([*parts, careless], seed=1, taps=(watch,))
    assert not runner.run(SECONDS), runner.exits
    assert set(failures) == set()
    assert len(depths) == 1
    assert careless.published == {row.topic for row in careless.outputs}
