"""Component as a ROS node: the node class of all executables with components."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.client import Client
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from needle_core.component import (
    ANSWER_TIMEOUT,
    Action,
    Actions,
    Answer,
    Call,
    Component,
    Diagnose,
    Exit,
    Input,
    Listen,
    Log,
    Moment,
    Output,
    Peers,
    Publish,
    RealPort,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.convert import from_ros, ros_type, to_ros
from needle_core.errors import UserError
from needle_core.message_types import rclpy_types
from needle_core.process.ros_domain import CONFLICT_HINT, Claim
from needle_core.ros.base_node import (
    STEADY_CLOCK,
    DiagnosticsPublisher,
    WholeNode,
    full_name,
    publishers_of,
    signature,
    subscribers_of,
    to_qos,
)
from needle_core.ros.parameters import NodeParameters
from needle_core.runners.process import Handlers

LOG_PERIOD = 2.0
"""Minimum time between two log lines of one kind [s]."""
_PEERS_PERIOD = 0.2


class ComponentNode(WholeNode):
    """Node that delivers messages and time to a component, and executes its actions.

    Parameters
    ----------
    name : str
        Name of the node.
    parameters : type
        Settings dataclass of the component: the parameters of the node.
    make : callable
        Returns the component, given its settings and the node's full name.
    ports : callable
        Returns the component's real ports by name, given its settings.
    node_arguments : dict
        Further arguments of rclpy's Node (context, parameter overrides).

    Attributes
    ----------
    component : Component
        The component.
    outputs : dict of str to Publisher
        Publishers by topic.
    peers : Peers
        Discovered nodes.
    exit : Exit or None
        Exit action of the component, once it has exited.

    Raises
    ------
    UserError
        If a parameter is unknown, of the wrong type, out of bounds or inconsistent with others.
    """

    def __init__(
        self,
        name: str,
        parameters: type[Any],
        make: Callable[[Any, str], Component],
        ports: Callable[[Any], Mapping[str, RealPort]] = lambda _: {},
        **node_arguments: Any,
    ) -> None:
        super().__init__(name, **node_arguments)
        self._own = name
        # A service whose reply is pending must not block other callbacks.
        self._group = ReentrantCallbackGroup()
        settings = NodeParameters(self, parameters, self._on_parameters).values
        self.component = make(settings, signature(self))
        if self.get_parameter("use_sim_time").value and not self.component.accepts_simulated_time:
            raise UserError(
                f"{self.get_fully_qualified_name()}: use_sim_time = true: this node runs in real "
                "time; only viewers of a replay take simulated time"
            )
        self.exit: Exit | None = None
        self._types = rclpy_types()
        self._diagnostics = DiagnosticsPublisher(self)
        self._handlers = Handlers(self.component.outputs)
        self._logged: dict[str, float] = {}
        self.peers = Peers()
        self._requests: dict[int, Future[Reply]] = {}
        self._calls: dict[int, tuple[Call, float, Future[Any] | None]] = {}
        self._numbers = itertools.count(1)
        self._service_clients: dict[str, Client[Any, Any]] = {}
        self._ports = dict(ports(settings))
        self._arrived: deque[tuple[str, Any]] = deque()
        self._claims: list[Claim] = []
        self._arrival_signal = self.create_guard_condition(self._handle_arrived)
        self.outputs = {row.topic: self._advertise(row) for row in self.component.outputs}
        self._lazy: dict[str, Subscription[Any]] = {}
        for row in self.component.inputs:
            if not row.lazy:
                self._subscribe(row)
        for service in self.component.services:
            self._offer(service)
        for timer in self.component.timers:
            self._repeat(timer)
        self.create_timer(_PEERS_PERIOD, self._update_peers, clock=STEADY_CLOCK)
        for port_name, port in self._ports.items():
            port.open(partial(self._arrive, port_name))
        self.get_logger().info(f"runs (ROS_DOMAIN_ID {self.context.get_domain_id()})")

    def stop(self) -> None:
        """Request the shutdown of the component."""
        self._handle(lambda: self.component.on_stop(self._moment()))

    def close(self) -> None:
        """Close the ports and release the exclusive topics."""
        for claim in self._claims:
            claim.release()
        for port in self._ports.values():
            port.close()

    def _moment(self, sent_ns: int = 0) -> Moment:
        return Moment(time.monotonic(), self.get_clock().now().nanoseconds, sent_ns)

    def _name_of(self, topic: str) -> str:
        """Return the name of a row for rclpy: private if it starts with the node's own name."""
        prefix = f"{self._own}/"
        return f"~/{topic.removeprefix(prefix)}" if topic.startswith(prefix) else topic

    # ---- rows ---------------------------------------------------------------------------------

    def _advertise(self, row: Output) -> Any:
        if row.exclusive:
            topic = self.resolve_topic_name(self._name_of(row.topic))
            name = f"{topic} of ROS_DOMAIN_ID {self.context.get_domain_id()}"
            try:
                self._claims.append(Claim(name, self.get_fully_qualified_name()))
            except UserError as error:
                raise UserError(
                    f"another publisher of {row.topic} is running: {error}; {CONFLICT_HINT}"
                ) from None
            self.context.on_shutdown(self._claims[-1].release)
        kind = self._types.make(ros_type(row.message))
        return self.create_publisher(kind, self._name_of(row.topic), to_qos(row.delivery))

    def _subscribe(self, row: Input) -> Subscription[Any]:
        def on_incompatible(_: Any) -> None:
            policy = "transient_local" if row.delivery.latched else "reliable"
            option = "durability" if row.delivery.latched else "reliability"
            why = f"a publisher's QoS is incompatible: --qos-{option} {policy} does"
            self._diagnostics.reject(row.topic, "incompatible QoS", why)

        kind = self._types.make(ros_type(row.message))
        # Raw, because an undecodable message must not raise inside the executor.
        return self.create_subscription(
            kind,
            self._name_of(row.topic),
            lambda data, info: self._on_bytes(row, kind, data, info),
            to_qos(row.delivery),
            raw=True,
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=on_incompatible),
        )

    def _listen(self, topic: str, on: bool) -> None:
        if on and topic not in self._lazy:
            row = next(row for row in self.component.inputs if row.topic == topic)
            self._lazy[topic] = self._subscribe(row)
        elif not on and topic in self._lazy:
            self.destroy_subscription(self._lazy.pop(topic))

    def _on_bytes(self, row: Input, kind: type[Any], data: bytes, info: Mapping[str, int]) -> None:
        if len(data) > row.max_bytes:
            why = f"{len(data)} bytes, at most {row.max_bytes}"
            self._diagnostics.reject(row.topic, "too long", why)
            return
        try:
            message = from_ros(row.message, deserialize_message(data, kind))
        except Exception as error:  # noqa: BLE001 - the middleware raises all kinds
            why = f"{len(data)} bytes: {type(error).__name__}: {error}"
            self._diagnostics.reject(row.topic, "undecodable", why)
            return
        sent_ns = info["source_timestamp"]
        self._handle(lambda: row.handler(message, self._moment(sent_ns)))

    def _repeat(self, timer: Timer) -> None:
        def run() -> None:
            # Handle port input that has arrived before the timer.
            self._handle_arrived()
            self._handle(lambda: timer.handler(self._moment()))

        self.create_timer(timer.period, run, clock=STEADY_CLOCK, callback_group=self._group)

    def _offer(self, service: Service) -> None:
        async def answer(request: Any, response: Any) -> Any:
            number = next(self._numbers)
            reply: Future[Reply] = Future(executor=self.executor)
            self._requests[number] = reply
            argument = request.data if service.has_argument else None
            self._handle(lambda: service.handler(argument, number, self._moment()))
            result = await reply
            response.success, response.message = result.success, result.text
            return response

        kind = SetBool if service.has_argument else Trigger
        name = self._name_of(service.name)
        self.create_service(kind, name, answer, callback_group=self._group)

    # ---- ports --------------------------------------------------------------------------------

    def _arrive(self, port: str, batch: Any) -> None:
        """Queue a batch or a port change, from a port's thread."""
        self._arrived.append((port, batch))
        self._arrival_signal.trigger()

    def _handle_arrived(self) -> None:
        while self._arrived:
            name, batch = self._arrived.popleft()
            batch = batch() if callable(batch) else batch
            for row in self.component.ports:
                if row.name == name:
                    handler = row.handler if isinstance(batch, tuple) else row.on_change
                    self._handle(lambda: handler(batch, self._moment()))  # noqa: B023 - called now

    # ---- actions ------------------------------------------------------------------------------

    def _handle(self, work: Callable[[], Actions]) -> None:
        """Execute the actions of a handler, unless the component has exited."""
        if self.exit is not None:
            return
        for action in self._handlers.run(work):
            self._execute(action)

    def _execute(self, action: Action) -> None:
        match action:
            case Publish(topic, message):
                self.outputs[topic].publish(to_ros(message, self._types))
            case Send(port, batch):
                self._ports[port].send(batch)
            case Call():
                self._call(action)
            case Reply(number):
                reply = self._requests.pop(number, None)
                if reply is not None:
                    reply.set_result(action)
            case Listen(topic, on):
                self._listen(topic, on)
            case Diagnose(part, diagnostic):
                self._diagnostics.set(part, diagnostic)
            case Log():
                self._log(action)
            case Exit():
                self.exit = action

    def _log(self, line: Log) -> None:
        now = time.monotonic()
        if line.kind:
            if now - self._logged.get(line.kind, -LOG_PERIOD) < LOG_PERIOD:
                return
            self._logged[line.kind] = now
        # Three calls, because rclpy identifies a line by its call site.
        if line.severity == "error":
            self.get_logger().error(line.text)
        elif line.severity == "warning":
            self.get_logger().warning(line.text)
        else:
            self.get_logger().info(line.text)

    # ---- calls --------------------------------------------------------------------------------

    def _call(self, call: Call) -> None:
        client = self._service_clients.get(call.service)
        if client is None:
            kind = Trigger if call.request is None else SetBool
            client = self.create_client(kind, call.service, callback_group=self._group)
            self._service_clients[call.service] = client
        number = next(self._numbers)
        future: Future[Any] | None = None
        if client.service_is_ready() or client.wait_for_service(0.0):
            has_argument = call.request is not None
            request = SetBool.Request(data=call.request) if has_argument else Trigger.Request()
            future = client.call_async(request)
            future.add_done_callback(partial(self._on_answer, number))
        self._calls[number] = (call, time.monotonic() + ANSWER_TIMEOUT, future)

    def _on_answer(self, number: int, future: Future[Any]) -> None:
        response = future.result()
        if response is not None:
            self._end_call(number, response.success, response.message)

    def _end_call(self, number: int, success: bool, text: str, *, answered: bool = True) -> None:
        call, _, _ = self._calls.pop(number, (None, 0.0, None))
        if call is not None:
            answer = Answer(call.service, success, text, answered)
            self._handle(lambda: self.component.on_answer(answer, self._moment()))

    def _fail_late_calls(self) -> None:
        now = time.monotonic()
        for number, (call, deadline, future) in list(self._calls.items()):
            if future is None or now >= deadline:
                if future is not None:
                    self._service_clients[call.service].remove_pending_request(future)
                why = "no server" if future is None else "no answer"
                self._end_call(number, False, why, answered=False)

    # ---- discovery and parameters -------------------------------------------------------------

    def _update_peers(self) -> None:
        self._fail_late_calls()
        rows: list[Input | Output] = [*self.component.inputs, *self.component.outputs]
        topics = {row.topic: self._name_of(row.topic) for row in rows}
        namespace = self.get_namespace().rstrip("/") + "/"
        services = {name for name, _ in self.get_service_names_and_types()}
        peers = Peers(
            _known({topic: publishers_of(self, name) for topic, name in topics.items()}),
            _known({topic: subscribers_of(self, name) for topic, name in topics.items()}),
            frozenset(name.removeprefix(namespace) for name in services),
            frozenset(full_name(space, name).lstrip("/") for name, space in self._nodes()),
        )
        if peers != self.peers:
            self.peers = peers
            self._handle(lambda: self.component.on_peers(peers, self._moment()))

    def _nodes(self) -> list[tuple[str, str]]:
        """Return names and namespaces of all nodes except hidden ones."""
        known = self.get_node_names_and_namespaces()
        return [(name, space) for name, space in known if not name.startswith("_")]

    def _on_parameters(self, settings: Any) -> None:
        self._handle(lambda: self.component.on_settings(settings, self._moment()))


def _known(names: Mapping[str, Iterable[str]]) -> dict[str, tuple[str, ...]]:
    """Return the topics that have endpoints, with node names without the leading slash."""
    found = {topic: tuple(sorted(n.lstrip("/") for n in some)) for topic, some in names.items()}
    return {topic: some for topic, some in found.items() if some}
