"""ComponentNode over real DDS: messages and port data reach a component."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from needle_core import messages as m
from needle_core.component import (
    LATCHED,
    Actions,
    Answer,
    Call,
    Component,
    Exit,
    Input,
    Listen,
    Moment,
    Output,
    Port,
    Publish,
    Reply,
    Send,
    Service,
    Timer,
)
from needle_core.errors import UserError
from needle_core.process.ros_domain import reserve_domain_id
from needle_core.ros import base_node
from needle_core.ros.component_node import ComponentNode
from needle_core.settings.parameter_fields import check_fields, parameter

TIMEOUT = 60.0  # [s]
LONGEST = 1000


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings with a parameter that may change."""

    gain: float = parameter(1.0, unit="-", lower=0.0, upper=10.0, description="A number.")

    def __post_init__(self) -> None:
        check_fields(self)


class Echo(Component):
    """Echoes messages, and executes commands in them."""

    name = "echo"

    def __init__(self, settings: Settings, name: str = name) -> None:
        self.name, self.settings = name, settings
        self.answers: list[Answer] = []
        self.waiting: int | None = None
        self.inputs = (
            Input("word", m.Text, self._on_word, max_bytes=LONGEST),
            Input("plan", m.Text, self._on_word, LATCHED),
            Input("whisper", m.Text, self._on_word, lazy=True),
        )
        self.outputs = (Output("said", m.Text), Output("echo/kept", m.Text, LATCHED))
        self.services = (
            Service("echo/later", self._later),
            Service("echo/twice", self._twice, has_argument=True),
        )
        self.timers = (Timer(0.05, self._tick),)
        self.ports = (Port("wire", self._on_batch),)

    def on_answer(self, answer: Answer, at: Moment) -> Actions:
        self.answers.append(answer)
        return ()

    def on_settings(self, settings: Settings, at: Moment) -> Actions:
        self.settings = settings
        yield Publish("said", m.Text(f"gain {settings.gain:g}"))

    def on_stop(self, at: Moment) -> Actions:
        yield Exit(4, "asked to")

    def _on_word(self, message: m.Text, at: Moment) -> Actions:
        yield Publish("said", m.Text(message.text))
        match message.text:
            case "fail":
                raise ValueError("no such word")
            case "call":
                yield Call("nobody/there")
            case "keep":
                yield Publish("echo/kept", m.Text("kept"))
            case "listen" | "leave":
                yield Listen("whisper", message.text == "listen")

    def _later(self, _: bool | None, number: int, at: Moment) -> Actions:
        self.waiting = number
        return ()

    def _twice(self, on: bool | None, number: int, at: Moment) -> Actions:
        yield Reply(number, bool(on), "once")
        yield Reply(number, not on, "twice")

    def _tick(self, at: Moment) -> Actions:
        if self.waiting is not None:
            yield Reply(self.waiting, True, "later")
            self.waiting = None

    def _on_batch(self, batch: Any, at: Moment) -> Actions:
        yield Send("wire", batch)


class Wire:
    """A port in memory, which delivers given items."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def open(self, arrive: Callable[[Any], None]) -> None:
        self.arrive = arrive

    def send(self, batch: tuple[Any, ...]) -> None:
        self.sent.append(batch)

    def close(self) -> None:
        self.sent.append("closed")


class Bench:
    """The node, and another node that talks to it."""

    def __init__(self, context: Context) -> None:
        self.context, self.wire = context, Wire()
        self.node = self.make()
        assert isinstance(self.node.component, Echo)
        self.echo = self.node.component
        self.other = Node("other", context=context)
        self.received: list[str] = []
        self.health: dict[str, str] = {}
        self.subscribe("said")
        self.other.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_health, base_node.RELIABLE
        )
        self.words = self.other.create_publisher(String, "word", base_node.RELIABLE)
        self._executor = SingleThreadedExecutor(context=context)
        for node in (self.node, self.other):
            self._executor.add_node(node)
        self.until(lambda: self.words.get_subscription_count() > 0)
        self.until(lambda: self.node.outputs["said"].get_subscription_count() > 0)

    def make(self, **parameters: Any) -> ComponentNode:
        given = [Parameter(name, value=value) for name, value in parameters.items()]
        return ComponentNode(
            "echo",
            Settings,
            Echo,
            lambda _: {"wire": self.wire},
            context=self.context,
            parameter_overrides=given,
        )

    def subscribe(self, topic: str, delivery: Any = base_node.RELIABLE) -> None:
        self.other.create_subscription(
            String, topic, lambda text: self.received.append(text.data), delivery
        )

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < end, (self.received, self.health, self.echo.answers)
            self._executor.spin_once(timeout_sec=0.02)

    def publish(self, text: str) -> None:
        """Publish a word, and wait for its echo."""
        before = len(self.received)
        self.words.publish(String(data=text))
        self.until(lambda: text in self.received[before:])

    def call(self, kind: type[Any], name: str, **request: Any) -> Any:
        client = self.other.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request(**request))
        self.until(future.done)
        return future.result()

    def close(self) -> None:
        self.node.close()
        self._executor.shutdown()
        self.node.destroy_node()
        self.other.destroy_node()

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.health[status.name] = f"{status.message} {values}"


@pytest.fixture
def bench() -> Iterator[Bench]:
    with reserve_domain_id() as domain:
        context = Context()
        rclpy.init(context=context, domain_id=domain)
        bench = Bench(context)
        yield bench
        bench.close()
        context.try_shutdown()


def test_bad_or_long_data_and_a_failing_handler_are_reported_and_end_nothing(bench: Bench) -> None:
    def health(part: str) -> str:
        return bench.health.get(f"echo: {part}", "")

    bench.words.publish(b"\x00\x01\x00")
    bench.until(lambda: "undecodable" in health("input"))
    bench.words.publish(String(data="x" * 2 * LONGEST))
    bench.until(lambda: "too long" in health("input") and "'refused word': '2'" in health("input"))
    # Actions before the failure of a handler are executed.
    bench.publish("fail")
    bench.until(lambda: "internal error: ValueError: no such word" in health("handlers"))
    bench.publish("on")
    assert bench.received == ["fail", "on"]


def test_services_ports_and_calls_are_answered(bench: Bench) -> None:
    later = bench.call(Trigger, "echo/later")
    assert (later.success, later.message) == (True, "later")
    for on in (True, False):
        now = bench.call(SetBool, "echo/twice", data=on)
        assert (now.success, now.message) == (on, "once")
    bench.publish("call")
    bench.until(lambda: bool(bench.echo.answers))
    assert bench.echo.answers == [Answer("nobody/there", False, "no server", answered=False)]
    bench.wire.arrive((1, 2))
    bench.wire.arrive(lambda: (3,))
    bench.until(lambda: len(bench.wire.sent) == 2)
    assert bench.wire.sent == [(1, 2), (3,)]
    bench.node.stop()
    bench.node.close()
    assert bench.node.exit == Exit(4, "asked to")
    assert bench.wire.sent[-1] == "closed"


def test_latched_messages_lazy_inputs_and_peers_and_a_qos_that_does_not_fit(bench: Bench) -> None:
    bench.publish("keep")
    bench.subscribe("echo/kept", base_node.LATCHED)
    bench.until(lambda: "kept" in bench.received)
    whisper = bench.other.create_publisher(String, "whisper", base_node.RELIABLE)
    for word, listeners in (("listen", 1), ("leave", 0)):
        bench.publish(word)
        bench.until(lambda n=listeners: whisper.get_subscription_count() == n)  # type: ignore[misc]
    bench.until(lambda: bench.node.peers.subscribers.get("said") == ("other",))
    assert bench.node.peers.publishers["word"] == ("other",)
    assert "echo/later" in bench.node.peers.services
    assert {"echo", "other"} <= bench.node.peers.nodes
    bench.other.create_publisher(String, "plan", base_node.RELIABLE)
    bench.until(lambda: "--qos-durability transient_local" in bench.health.get("echo: input", ""))


def test_parameters_are_applied_together_typed_and_within_bounds_or_rejected(bench: Bench) -> None:
    def message(value: Any) -> ParameterMessage:
        return Parameter("gain", value=value).to_parameter_msg()

    def set_to(*parameters: ParameterMessage) -> tuple[bool, str]:
        answer = bench.call(SetParameters, "echo/set_parameters", parameters=list(parameters))
        return answer.results[-1].successful, answer.results[0].reason

    assert set_to(message(2.0)) == (True, "")
    bench.until(lambda: bench.received == ["gain 2"])
    assert not set_to(message(20.0))[0]
    clock = Parameter("use_sim_time", value=True).to_parameter_msg()
    assert set_to(clock) == (False, "use_sim_time is fixed at start")
    assert bench.echo.settings == Settings(2.0)
    with pytest.raises(UserError, match="/echo: use_sim_time = true: this node runs in real time"):
        bench.make(use_sim_time=True)
