"""The `operator` executable: what a person holds becomes the hold to run."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import Joy
from std_srvs.srv import Trigger

from needle_bringup.operator.event_source import Device, EventSource
from needle_bringup.operator.hold_gate import Grip, Held, HoldGate
from needle_bringup.operator.input_device import InputDevice
from needle_bringup.operator.joy_source import JoySource
from needle_bringup.operator.retraction import RETRACT, STOP_STEERING, Retraction
from needle_bringup.ros.operator_parameters import JOY, OperatorParameters
from needle_core.commands.cli import EXIT_DONE
from needle_core.diagnostics import Diagnostic, Level
from needle_core.messages import HOLD_LIFETIME
from needle_core.process.end_request import EndRequest
from needle_core.ros.base_node import (
    LOOK_PERIOD,
    STEADY_CLOCK,
    DiagnosticsPublisher,
    executor_of,
    run_node,
)
from needle_core.ros.bounded_subscription import listen
from needle_core.ros.conversions import HOLD, LATCHED, to_nanoseconds, values_of
from needle_core.ros.hold_topic import HoldTopic
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

HOLD_RATE = 50.0
DEVICE_STOP = "device/stop"
# The hold is best effort: a release worth sending is worth sending again.
RELEASES = 3
_RELEASE_PERIOD = 0.02


class OperatorNode(WholeNode):
    """Shell around a source, `HoldGate` and `Retraction`.

    Parameters
    ----------
    open_device : callable
        Opens an event device.
    """

    def __init__(self, open_device: Callable[[str], Device] = InputDevice) -> None:
        super().__init__("operator")
        self._settings = NodeParameters(self, OperatorParameters)
        self._diagnostics = DiagnosticsPublisher(self)
        self._source = self._make_source(open_device)
        self._gate = HoldGate()
        self._retraction = Retraction(self.get_name())
        self._grip = Grip()
        self._press_again = False
        self._told = ""
        self._hold = HoldTopic(self, self.get_name(), HOLD_LIFETIME)
        self._service_clients = {
            name: self.create_client(Trigger, name)
            for name in (DEVICE_STOP, RETRACT, STOP_STEERING)
        }
        self.create_subscription(DiagnosticStatus, "device/status", self._on_device, LATCHED)
        self._life = LifeSigns(self, self._diagnostics, "holds for a person", self._missing)
        # The hold must not follow simulated time: steady clock.
        self.create_timer(1.0 / HOLD_RATE, self._on_timer, clock=STEADY_CLOCK)

    def release(self) -> None:
        """Say that nothing is held."""
        self._hold.publish(pressed=False, speed=0.0)

    def _make_source(self, open_device: Callable[[str], Device]) -> EventSource | JoySource:
        values = self._settings.values

        def speed() -> float:
            return self._settings.values.speed_scale

        if values.source != JOY:
            return EventSource(values.device, values.controls, speed, open_device)

        def on_joy(messages: list[Joy]) -> None:
            last = messages[-1]
            stamp = to_nanoseconds(last.header.stamp) / 1e9
            joy.take(last.axes, last.buttons, time.monotonic(), stamp=stamp)

        # The newest alone: what waited behind a stall is no hand of now.
        topic = listen(self, Joy, "joy", on_joy, HOLD, refuse=self._diagnostics.refuse)
        joy = JoySource(values.controls, speed, topic.get_publisher_count)
        return joy

    def _missing(self) -> list[str]:
        missing = [] if self._hold.is_heard else ["subscriber of device/hold"]
        return [self._grip.trouble, *missing] if self._grip.trouble else missing

    def _on_timer(self) -> None:
        now = time.monotonic()
        grip = self._grip = self._gate.take(self._source.read(now), now)
        controller = self._service_clients[STOP_STEERING].service_is_ready()
        call = self._retraction.look(grip.held is Held.RETRACT, now, controller=controller)
        pressed = grip.held is Held.INSERT or self._retraction.holds
        self._hold.publish(pressed=pressed, speed=grip.speed)
        if grip.stop:
            self._call(DEVICE_STOP)
        if call is not None:
            self._call(call)
        self._report()

    def _call(self, service: str) -> None:
        future = self._service_clients[service].call_async(Trigger.Request())
        future.add_done_callback(functools.partial(self._on_answer, service))

    def _on_answer(self, service: str, future: Future[Any]) -> None:
        answer = future.result()
        if answer is not None:
            self._retraction.take_answer(service, answer.success, answer.message, time.monotonic())

    def _on_device(self, message: DiagnosticStatus) -> None:
        values = values_of(message)
        self._press_again = values.get("press_again") == self.get_name()
        owner, activity = values.get("hold_owner", ""), values.get("activity", "")
        self._retraction.see_device(owner, activity, time.monotonic())

    def _report(self) -> None:
        level, text = self._health()
        self._diagnostics.set("hold", Diagnostic(level, text))
        if text == self._told:
            return
        self._told = text
        # rclpy wants each place in the code to keep to one level.
        if level is Level.OK:
            self.get_logger().info(text)
        else:
            self.get_logger().warning(text)

    def _health(self) -> tuple[Level, str]:
        grip = self._grip
        if grip.trouble:
            return Level.WARN, f"nothing is held: {grip.trouble}"
        if self._retraction.trouble:
            return Level.WARN, f"not drawn out: {self._retraction.trouble}"
        if grip.unheeded:
            return Level.WARN, "what is held does not count: let go of all, then press again"
        if self._press_again and grip.held is not Held.NOTHING:
            return Level.WARN, "the device does not take this press: let go, then press again"
        return Level.OK, {
            Held.NOTHING: "nothing is held",
            Held.INSERT: "held to insert",
            Held.RETRACT: "held to draw the needle out",
        }[grip.held]


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
