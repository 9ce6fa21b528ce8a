"""The `simulated_operator` executable: keeps the hold in simulation, in a person's stead."""

from __future__ import annotations

import dataclasses
import functools
import os
import sys
import time
from typing import Any, TextIO

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.client import Client
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from needle_bringup.simulated_operator.operator_sequence import (
    DISABLE,
    PREPARATION,
    OperatorSequence,
    ServiceCall,
)
from needle_bringup.simulated_operator.parameters import SimulatedOperatorParameters
from needle_bringup.simulated_operator.progress import PROGRESS_FD, Progress
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_INTERRUPTED, EXIT_MISSED
from needle_core.diagnostics import Diagnostic, Level
from needle_core.process.end_request import EndRequest
from needle_core.process.reach import DISCOVERY, is_open
from needle_core.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher, executor_of, run_node
from needle_core.ros.conversions import LATCHED, RELIABLE, values_of
from needle_core.ros.discovery import PARAMETERS_OF, RECORDER, full_name, publishers_of
from needle_core.ros.hold_topic import HoldTopic
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode
from needle_core.status_messages import ControllerStatus, DeviceStatus

HELP = """\
simulated_operator: stands in for the person who holds the needle's switch, in simulation.

Confirms that the needle is out, homes, enables, starts the controller, then keeps the hold until
the controller is DONE or in FAULT; releases and disables at the end, also on Ctrl-C. Draws the
progress. It acts only on a device that is alone and says in device/status that it is simulated: on
a rig that moves a real needle a person holds. A call that is not answered is made again after 1 s,
home and start only where the statuses do not show that they were taken.

Publishes   device/hold
Subscribes  needle/controller_status, device/status
Calls       device/confirm_needle_out, device/home, device/enable, plane_controller/start
Exit code   0 when the depth was reached, 1 when it was not, 2 when the rig did not get ready or for
            bad parameters, 130 when interrupted
"""

DISABLE_TIMEOUT = 1.0
# After a signal the driver may be gone, too.
DISABLE_TIMEOUT_INTERRUPTED = 0.3
RELEASES = 3


class SimulatedOperatorNode(WholeNode):
    """Shell around `OperatorSequence`: calls what it asks for and tells it what was heard."""

    def __init__(self) -> None:
        super().__init__("simulated_operator")
        self._settings = NodeParameters(self, SimulatedOperatorParameters)
        values = self._settings.values
        self._sequence = OperatorSequence(
            time.monotonic(),
            self.get_name(),
            wait_timeout=values.wait_timeout,
            stall_timeout=values.stall_timeout,
            look_around=DISCOVERY if is_open() else 0.0,
        )
        self._progress = Progress(_progress_stream())
        self._diagnostics = DiagnosticsPublisher(self)
        self._service_clients: dict[str, Client[Any, Any]] = {
            call.service: self.create_client(
                Trigger if call.data is None else SetBool, call.service
            )
            for call in PREPARATION
        }
        self._recorded_nodes: set[str] = set()
        if values.wait_for_recorder:
            self.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, RELIABLE)
        self._hold = HoldTopic(self, self.get_name())
        self._controller_status = self.create_subscription(
            DiagnosticStatus, "needle/controller_status", self._on_controller_status, LATCHED
        )
        self._device_status = self.create_subscription(
            DiagnosticStatus, "device/status", self._on_device_status, LATCHED
        )
        self._life = LifeSigns(
            self,
            self._diagnostics,
            "stands in for the person who holds",
            self._waits_for,
            alone_on=("device/hold",),
        )
        # The hold must not follow simulated time: steady clock.
        self.create_timer(1.0 / values.hold_rate, self._on_timer, clock=STEADY_CLOCK)

    @property
    def ended(self) -> bool:
        """Tell whether the run is over, by success, failure or signal."""
        return self._sequence.outcome is not None

    def interrupt(self) -> None:
        """End the run at the next turn of the loop."""
        self._sequence.interrupt()

    def finish(self, executor: SingleThreadedExecutor) -> int:
        """Release the hold, disable the drives, say how it went; returns the exit code."""
        outcome = self._sequence.outcome
        assert outcome is not None
        disabled: Future[Any] | None = None
        if self._sequence.touched:
            self._send_hold(pressed=False)
            disabled = self._call(DISABLE)
            # The hold is best effort: a release worth sending is worth sending again.
            for _ in range(RELEASES - 1):
                executor.spin_once(timeout_sec=0.02)
                self._send_hold(pressed=False)
        line = f"simulated_operator: {outcome.reason}"
        supervised = self._progress.stream is not sys.stderr
        # Whoever supervises knows why it interrupts, and says so.
        self._progress.close("" if supervised and outcome.interrupted else line)
        if supervised:
            print(line, file=sys.stderr)
        timeout = DISABLE_TIMEOUT_INTERRUPTED if outcome.interrupted else DISABLE_TIMEOUT
        deadline = time.monotonic() + timeout
        while disabled is not None and not disabled.done() and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.05)
        if outcome.interrupted:
            return EXIT_INTERRUPTED
        if not outcome.prepared:
            return EXIT_BAD_INPUT
        return EXIT_DONE if outcome.done else EXIT_MISSED

    def _on_timer(self) -> None:
        self._sequence.see_devices(publishers_of(self, "device/status"))
        if self._sequence.steering:
            self._send_hold(pressed=self._sequence.hold())
        else:
            self._sequence.see_missing(self._missing())
        self._sequence.check_time(time.monotonic())
        self._advance()

    def _advance(self) -> None:
        call = self._sequence.next_call(time.monotonic())
        if call is not None:
            self._call(call).add_done_callback(functools.partial(self._on_answer, call))
        self._report()

    def _on_answer(self, call: ServiceCall, future: Future[Any]) -> None:
        answer = future.result()
        if answer is not None:
            self._sequence.take_answer(call, answer.success, answer.message, time.monotonic())
            self._advance()

    def _on_controller_status(self, message: DiagnosticStatus) -> None:
        self._sequence.see_controller(ControllerStatus.parse(values_of(message)), time.monotonic())
        if self._sequence.steering and self._sequence.depth is not None:
            self._progress.show(self._sequence.insertion, self._sequence.depth)
            self._progress.tell_wait(self._sequence.waits_because)

    def _on_device_status(self, message: DiagnosticStatus) -> None:
        said = DeviceStatus.parse(values_of(message))
        said = dataclasses.replace(said, source=f"/{message.hardware_id}")
        self._sequence.see_device(said, time.monotonic())
        self._advance()

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.rpartition("/")[2] == f"{RECORDER}: {PARAMETERS_OF}":
                self._recorded_nodes = set(status.message.split(", "))

    def _unrecorded_nodes(self) -> list[str]:
        """Return whose parameters are not in the bag yet: without them no run can be repeated."""
        if not self._settings.values.wait_for_recorder:
            return []
        names = {
            full_name(namespace, name)
            for name, namespace in self.get_node_names_and_namespaces()
            if not name.startswith("_")
        }
        return [f"recorder of {name}'s parameters" for name in sorted(names - self._recorded_nodes)]

    def _missing(self) -> list[str]:
        missing = [
            f"service {name}"
            for name, client in self._service_clients.items()
            if not client.service_is_ready()
        ]
        for subscription in (self._controller_status, self._device_status):
            if not subscription.get_publisher_count():
                missing.append(f"publisher of {subscription.topic_name}")
        if not self._hold.is_heard:
            missing.append("subscriber of device/hold")
        return missing or self._unrecorded_nodes()

    def _waits_for(self) -> list[str]:
        if self._sequence.steering or self.ended:
            return []
        return self._missing() or [self._sequence.hangs()]

    def _call(self, call: ServiceCall) -> Future[Any]:
        request = Trigger.Request() if call.data is None else SetBool.Request(data=call.data)
        return self._service_clients[call.service].call_async(request)

    def _send_hold(self, *, pressed: bool) -> None:
        self._hold.publish(pressed=pressed, speed=self._settings.values.speed_scale)

    def _report(self) -> None:
        if self._sequence.steering:
            again = self._sequence.presses_again
            message = "the hold is pressed" + (f" (pressed again {again} times)" if again else "")
        elif self.ended:
            message = "the hold is released"
        else:
            message = "prepares the rig"
        self._diagnostics.set("hold", Diagnostic(Level.OK, message))


def _progress_stream() -> TextIO:
    """Return where the progress goes: stderr, or what the supervisor keeps open for it."""
    descriptor = os.environ.get(PROGRESS_FD)
    if descriptor is None:
        return sys.stderr
    return os.fdopen(int(descriptor), "w", encoding="utf-8", buffering=1)


def _spin(node: Node, end: EndRequest) -> int:
    """Run the stand-in until its run is over; returns its exit code."""
    assert isinstance(node, SimulatedOperatorNode)
    executor = executor_of(node)
    try:
        while not node.ended:
            if end.wanted:
                node.interrupt()
            executor.spin_once(timeout_sec=0.05)
        code = node.finish(executor)
    finally:
        executor.shutdown()
    # Others end on the same signal: what failed for want of them was interrupted.
    return EXIT_INTERRUPTED if end.wanted and code != EXIT_DONE else code


def main() -> int:
    """Run the stand-in; returns its exit code."""
    return run_node(
        SimulatedOperatorNode,
        help_text=HELP,
        parameters=SimulatedOperatorParameters,
        spin=_spin,
        interrupted=EXIT_INTERRUPTED,
        shared_memory=False,
    )
