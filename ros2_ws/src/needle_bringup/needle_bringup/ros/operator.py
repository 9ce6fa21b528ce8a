"""The `operator` executable: the component `Operator` as a ROS node, with its input device."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import Trigger

from needle_bringup.operator.component import CALLED, HOLD, PERIOD, RELEASES, Operator
from needle_bringup.operator.event_source import Device, EventSource
from needle_bringup.operator.input_device import InputDevice
from needle_bringup.operator.parameters import JOY, OperatorParameters
from needle_core.commands.cli import EXIT_DONE
from needle_core.component import (
    Actions,
    Answer,
    Call,
    Diagnose,
    Input,
    Log,
    Moment,
    Peers,
    Publish,
)
from needle_core.convert import Converter, from_ros, ros_type
from needle_core.message_types import rclpy_types
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import (
    LOOK_PERIOD,
    STEADY_CLOCK,
    DiagnosticsPublisher,
    executor_of,
    run_node,
)
from needle_core.ros.bounded_subscription import listen
from needle_core.ros.conversions import to_qos
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode

HELP = """\
operator: holds the needle's switch for a person: a foot pedal, a key, a joystick.

A pedal, key or joystick by its event device (source pedal or joystick, device, key), or a
joystick behind a topic of sensor_msgs/Joy (source joy), which must talk at 20 Hz or more. Held, the
needle is inserted, or drawn out with retract_key; released, unplugged, silent or frozen it stops.
What is held at the start or after a loss counts only when all was let go of and it is pressed
again. To draw the needle out, a plane_controller that steers is stopped first.

Publishes   device/hold
Subscribes  joy (source joy), device/status
Calls       device/stop, device/retract, plane_controller/stop
"""

_RELEASE_PERIOD = 0.02


class OperatorNode(WholeNode):
    """The ROS shell of `Operator`: hears, reads the input device, publishes, calls.

    Parameters
    ----------
    open_device : callable
        Opens an event device.
    """

    def __init__(self, open_device: Callable[[str], Device] = InputDevice) -> None:
        super().__init__("operator")
        self._settings = NodeParameters(self, OperatorParameters, self._on_parameters)
        values = self._settings.values
        self._component = Operator(values, self.get_name())
        self._types = rclpy_types()
        self._converter = Converter(self._types)
        self._diagnostics = DiagnosticsPublisher(self)
        (row,) = self._component.outputs
        kind = self._types.make(ros_type(row.message))
        self._hold = self.create_publisher(kind, HOLD, to_qos(row.delivery))
        self._service_clients = {name: self.create_client(Trigger, name) for name in CALLED}
        self._sources = {row.topic: self._hear(row) for row in self._component.inputs}
        self._life = LifeSigns(self, self._diagnostics, "holds for a person", self._missing)
        if values.source == JOY:
            look = self._component.timers[0].handler
        else:
            source = EventSource(
                values.device,
                values.controls,
                lambda: self._settings.values.speed_scale,
                open_device,
            )
            (port,) = self._component.ports

            def look(at: Moment) -> Actions:
                return port.handler((source.read(at.steady),), at)

        # The hold must not follow simulated time: steady clock.
        self.create_timer(PERIOD, functools.partial(self._on_timer, look), clock=STEADY_CLOCK)

    def release(self) -> None:
        """Say that nothing is held."""
        self._do((self._component.hold(_now(), pressed=False, speed=0.0),))

    def _hear(self, row: Input) -> Any:
        def hear(messages: list[Any]) -> None:
            self._do(row.handler(from_ros(row.message, messages[-1]), _now()))

        kind, qos = self._types.make(ros_type(row.message)), to_qos(row.delivery)
        return listen(self, kind, row.topic, hear, qos, refuse=self._diagnostics.refuse)

    def _missing(self) -> list[str]:
        missing = [] if self._hold.get_subscription_count() else [f"subscriber of {HOLD}"]
        trouble = self._component.trouble
        return [trouble, *missing] if trouble else missing

    def _on_timer(self, look: Callable[[Moment], Actions]) -> None:
        at = _now()
        publishers = {
            topic: (topic,) * source.get_publisher_count()
            for topic, source in self._sources.items()
        }
        ready = (
            name for name, client in self._service_clients.items() if client.service_is_ready()
        )
        self._do(self._component.on_peers(Peers(publishers, {}, frozenset(ready)), at))
        self._do(look(at))

    def _on_parameters(self, values: OperatorParameters) -> None:
        self._do(self._component.on_settings(values, _now()))

    def _do(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish(_, message):
                    self._hold.publish(self._converter.to_ros(message))
                case Call(service):
                    future = self._service_clients[service].call_async(Trigger.Request())
                    future.add_done_callback(functools.partial(self._on_answer, service))
                case Diagnose(part, diagnostic):
                    self._diagnostics.set(part, diagnostic)
                # rclpy wants each place in the code to keep to one level.
                case Log("info", text):
                    self.get_logger().info(text)
                case Log(_, text):
                    self.get_logger().warning(text)

    def _on_answer(self, service: str, future: Future[Any]) -> None:
        reply = future.result()
        if reply is not None:
            answer = Answer(service, reply.success, reply.message)
            self._do(self._component.on_answer(answer, _now()))


def _now() -> Moment:
    return Moment(time.monotonic(), time.time_ns())


def _spin(node: Node, end: EndRequest) -> int:
    """Run the operator until a signal; what was held is released then."""
    assert isinstance(node, OperatorNode)
    with executor_of(node) as executor:
        while not end.wanted:
            executor.spin_once(timeout_sec=LOOK_PERIOD)
    for _ in range(RELEASES):
        node.release()
        time.sleep(_RELEASE_PERIOD)
    return EXIT_DONE


def main(open_device: Callable[[str], Device] = InputDevice) -> int:
    """Run the operator; returns its exit code."""
    create = functools.partial(OperatorNode, open_device)
    return run_node(
        create, help_text=HELP, parameters=OperatorParameters, spin=_spin, shared_memory=False
    )
