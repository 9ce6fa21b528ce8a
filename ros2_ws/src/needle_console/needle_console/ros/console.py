"""The `console` executable: the component `Console` as a ROS node, and the servers of its page."""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol

from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from needle_console.console import (
    CALLS,
    CONTROLLER_STATUS,
    DEVICE_STATUS,
    Console,
    image_topic,
)
from needle_console.console_parameters import ConsoleParameters
from needle_console.page.desk import Desk
from needle_console.view.camera_feed import SIDES
from needle_core.commands.cli import EXIT_BAD_INPUT, EXIT_DONE
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
    Send,
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
from needle_core.ros.conversions import to_qos
from needle_core.ros.life_signs import LifeSigns
from needle_core.ros.parameters import NodeParameters
from needle_core.ros.whole_node import WholeNode

_LOOK_PERIOD = 0.2
# So long an answer is waited for [s].
_PATIENCE = 2.0
HELP = """\
console: serves a page that shows what the rig sees and believes, with a hold to steer it by.

Publishes   device/hold (always; pressed only while a person holds), target_plane, target_point
Subscribes  device/status, needle/controller_status, joint_states, needle/tip_pose, needle/estimate,
            target_plane, /diagnostics, and while a page is open stereo/{left,right}/image_raw
Calls       device/{confirm_needle_out,home,enable,stop,retract,reset},
            plane_controller/{start,stop}
"""


class Served(Protocol):
    """Servers with threads of their own."""

    def start(self) -> None:
        """Begin to serve."""

    def close(self) -> None:
        """End."""


class ConsoleNode(WholeNode):
    """The ROS shell of `Console`: hears, publishes, calls, reports.

    Parameters
    ----------
    serve : callable
        Makes the servers of page and hold at a desk.
    node_arguments : dict
        Passed on to rclpy's Node (a context of its own, parameter overrides).

    Attributes
    ----------
    desk : Desk
        What pages show and do.

    Raises
    ------
    UserError
        A parameter that cannot be, or a port that is taken.
    """

    def __init__(
        self, serve: Callable[[Desk, ConsoleParameters], Served], **node_arguments: Any
    ) -> None:
        super().__init__("console", **node_arguments)
        values = NodeParameters(self, ConsoleParameters).values
        self._component = Console(values)
        self._types = rclpy_types()
        self._converter = Converter(self._types)
        self._outputs = {
            row.topic: self.create_publisher(
                self._types.make(ros_type(row.message)), row.topic, to_qos(row.delivery)
            )
            for row in self._component.outputs
        }
        self._diagnostics = DiagnosticsPublisher(self)
        self._callees = {
            call.service: self.create_client(
                Trigger if call.request is None else SetBool, call.service
            )
            for call in CALLS.values()
        }
        self._pending: dict[Future[Any], tuple[str, float]] = {}
        views = {image_topic(side) for side in SIDES}
        self._image_rows = [row for row in self._component.inputs if row.topic in views]
        self._images: list[Subscription[Any]] = []
        for row in self._component.inputs:
            if row not in self._image_rows:
                self._hear(row)
        bell = self.create_guard_condition(self._take)
        self.desk = Desk(values.calibration_file, bell.trigger)
        self._servers = serve(self.desk, values)
        for timer in self._component.timers:
            run = partial(self._on_timer, timer.handler)
            self.create_timer(timer.period, run, clock=STEADY_CLOCK)
        self.create_timer(_LOOK_PERIOD, self._look, clock=STEADY_CLOCK)
        line = f"page on http://{values.address}:{values.port}/"
        self._life = LifeSigns(self, self._diagnostics, line, self._waits_for)
        self._servers.start()

    def close(self) -> None:
        """Release the hold, end both servers, and say so."""
        self._servers.close()
        self._take()

    def _moment(self) -> Moment:
        # Not the node's own clock: where that is simulated, stamps of the hold would go back.
        return Moment(time.monotonic(), time.time_ns())

    def _hear(self, row: Input) -> Subscription[Any]:
        kind = self._types.make(ros_type(row.message))
        hear = partial(self._on_message, row)
        return self.create_subscription(kind, row.topic, hear, to_qos(row.delivery))

    def _on_message(self, row: Input, message: Any) -> None:
        self._do(row.handler(from_ros(row.message, message), self._moment()))

    def _on_timer(self, handler: Callable[[Moment], Actions]) -> None:
        self._do(handler(self._moment()))

    def _take(self) -> None:
        (port,) = self._component.ports
        self._do(port.handler(self.desk.take(), self._moment()))

    def _look(self) -> None:
        """See whether a controller is there, whether a page asks for images, who never answers."""
        if not self.count_publishers(CONTROLLER_STATUS):
            self._do(self._component.on_peers(Peers(), self._moment()))
        wanted = self.desk.wants_images
        if wanted and not self._images:
            self._images = [self._hear(row) for row in self._image_rows]
        elif not wanted:
            for subscription in self._images:
                self.destroy_subscription(subscription)
            self._images = []
        for future, (service, asked_at) in list(self._pending.items()):
            if time.monotonic() - asked_at > _PATIENCE:
                del self._pending[future]
                self._callees[service].remove_pending_request(future)
                self._answer(Answer(service, False, "no answer", answered=False))

    def _waits_for(self) -> list[str]:
        topics = (DEVICE_STATUS, CONTROLLER_STATUS)
        return [f"publisher of {topic}" for topic in topics if not self.count_publishers(topic)]

    def _do(self, actions: Actions) -> None:
        for action in actions:
            match action:
                case Publish(topic, message):
                    self._outputs[topic].publish(self._converter.to_ros(message))
                case Send(_, batch):
                    self.desk.send(batch)
                case Call():
                    self._call(action)
                case Diagnose(part, diagnostic):
                    self._diagnostics.set(part, diagnostic)
                case Log(_, text):
                    self.get_logger().warning(text)

    # ---- services -------------------------------------------------------------------------------

    def _call(self, call: Call) -> None:
        client = self._callees[call.service]
        if not client.service_is_ready():
            self._answer(Answer(call.service, False, "no server is there", answered=False))
            return
        request: Any = Trigger.Request()
        if call.request is not None:
            request = SetBool.Request(data=call.request)
        future = client.call_async(request)
        self._pending[future] = call.service, time.monotonic()
        future.add_done_callback(partial(self._on_response, call.service))

    def _on_response(self, service: str, future: Future[Any]) -> None:
        self._pending.pop(future, None)
        response = future.result()
        if response is not None:
            self._answer(Answer(service, response.success, response.message))

    def _answer(self, answer: Answer) -> None:
        self._do(self._component.on_answer(answer, self._moment()))


def main() -> int:
    """Run the console; returns its exit code."""
    if importlib.util.find_spec("nicegui") is None:
        print("error: NiceGUI is not installed; scripts/console installs it", file=sys.stderr)
        return EXIT_BAD_INPUT
    # What cannot be imported without NiceGUI is imported where it is there.
    from needle_console.page.web_server import ConsoleServers  # noqa: PLC0415

    create = partial(ConsoleNode, ConsoleServers)
    return run_node(create, help_text=HELP, parameters=ConsoleParameters, spin=_spin)


def _spin(node: Node, end: EndRequest) -> int:
    assert isinstance(node, ConsoleNode)
    with executor_of(node) as executor:
        while not end.wanted:
            executor.spin_once(timeout_sec=LOOK_PERIOD)
        node.close()
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
