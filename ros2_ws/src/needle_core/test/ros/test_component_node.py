"""The one node class: what comes over DDS and from ports reaches a component, whatever it is."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
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
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import RELIABLE
from needle_core.settings.parameter_fields import check_fields, parameter
from own_context import own_context

LIMIT = 20.0
LONGEST = 1000


@dataclasses.dataclass(frozen=True)
class Settings:
    """One number that may change."""

    gain: float = parameter(1.0, unit="-", lower=0.0, upper=10.0, description="A number.")

    def __post_init__(self) -> None:
        check_fields(self)


class Echo(Component):
    """Says again what it hears, and keeps what befalls it."""

    name = "echo"

    def __init__(self, settings: Settings, name: str = name) -> None:
        self.name, self.settings = name, settings
        self.answers: list[Answer] = []
        self.batches: list[Any] = []
        self.waiting: int | None = None
        self.inputs = (
            Input("word", m.Text, self._on_word, longest=LONGEST),
            Input("plan", m.Text, self._on_word, LATCHED),
        )
        self.outputs = (Output("said", m.Text), Output("echo/own", m.Text, LATCHED))
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
        if message.text == "fail":
            raise ValueError("no such word")
        if message.text == "call":
            yield Call("nobody/there")

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
        self.batches.append(batch)
        yield Send("wire", ("seen", *batch))


class Wire:
    """A port in memory."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def open(self, arrive: Callable[[Any], None]) -> None:
        self.arrive = arrive

    def send(self, batch: tuple[Any, ...]) -> None:
        self.sent.append(batch)

    def close(self) -> None:
        self.sent.append("closed")


class Bench:
    """The node, and somebody who talks to it."""

    def __init__(self, context: Any, **parameters: Any) -> None:
        self.wire = Wire()
        self.node = ComponentNode(
            "echo",
            Settings,
            Echo,
            lambda _: {"wire": self.wire},
            context=context,
            parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()],
        )
        assert isinstance(self.node.component, Echo)
        self.echo = self.node.component
        self.other = Node("other", context=context)
        self.heard: list[str] = []
        self.other.create_subscription(
            String, "said", lambda s: self.heard.append(s.data), RELIABLE
        )
        self.words = self.other.create_publisher(String, "word", RELIABLE)
        self._executor = SingleThreadedExecutor(context=context)
        for node in (self.node, self.other):
            self._executor.add_node(node)
        self.until(lambda: self.words.get_subscription_count() > 0)
        self.until(lambda: self.node.outputs["said"].get_subscription_count() > 0)

    def until(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, (self.heard, self.echo.answers)
            self._executor.spin_once(timeout_sec=0.02)

    def say(self, text: str) -> None:
        self.words.publish(String(data=text))

    def call(self, kind: type[Any], name: str, **request: Any) -> Any:
        client = self.other.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(kind.Request(**request))
        self.until(future.done)
        return future.result()

    def part(self, name: str) -> str:
        diagnostic = self.node._diagnostics._parts.get(name)
        return "" if diagnostic is None else f"{diagnostic.message} {diagnostic.values}"

    def close(self) -> None:
        self.node.close()
        self._executor.shutdown()
        self.node.destroy_node()
        self.other.destroy_node()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context)
        yield bench
        bench.close()


def test_bad_bytes_and_long_ones_are_refused_by_name_and_end_nothing(bench: Bench) -> None:
    bench.words.publish(b"\x00\x01\x00")
    bench.until(lambda: "undecodable" in bench.part("input"))
    bench.say("x" * 2 * LONGEST)
    bench.until(lambda: "too long" in bench.part("input"))
    bench.say("still here")
    bench.until(lambda: bench.heard == ["still here"])
    assert "'refused word': '2'" in bench.part("input")


def test_what_a_handler_did_before_it_failed_is_done_and_it_is_reported(bench: Bench) -> None:
    bench.say("fail")
    bench.until(lambda: "internal error: ValueError: no such word" in bench.part("handlers"))
    bench.until(lambda: bench.heard == ["fail"])
    bench.say("on")
    bench.until(lambda: bench.heard == ["fail", "on"])


def test_services_answer_once_now_or_later(bench: Bench) -> None:
    later = bench.call(Trigger, "echo/later")
    assert (later.success, later.message) == (True, "later")
    for on in (True, False):
        now = bench.call(SetBool, "echo/twice", data=on)
        assert (now.success, now.message) == (on, "once")


def test_a_call_of_a_service_that_nobody_offers_is_answered(bench: Bench) -> None:
    bench.say("call")
    bench.until(lambda: bool(bench.echo.answers))
    assert bench.echo.answers == [Answer("nobody/there", False, "no server", answered=False)]


def test_a_batch_of_a_port_arrives_whole_and_what_is_sent_goes_out(bench: Bench) -> None:
    bench.wire.arrive((1, 2))
    bench.wire.arrive(lambda: (3,))
    bench.until(lambda: sum(map(len, bench.echo.batches)) == 3)
    assert [item for batch in bench.echo.batches for item in batch] == [1, 2, 3]
    assert all(batch[0] == "seen" for batch in bench.wire.sent)


def test_changed_parameters_reach_the_component_and_bad_ones_do_not(bench: Bench) -> None:
    (good,) = bench.node.set_parameters([Parameter("gain", value=2.0)])
    assert good.successful
    bench.until(lambda: bench.heard == ["gain 2"])
    (bad,) = bench.node.set_parameters([Parameter("gain", value=20.0)])
    assert not bad.successful
    assert bench.echo.settings.gain == 2.0


def test_it_knows_who_else_is_there(bench: Bench) -> None:
    bench.until(lambda: bench.node.peers.subscribers.get("said") == ("other",))
    assert bench.node.peers.publishers["word"] == ("other",)
    assert "echo/later" in bench.node.peers.services
    assert {"echo", "other"} <= bench.node.peers.nodes


def test_a_publisher_that_does_not_keep_its_last_is_named_with_the_cure(bench: Bench) -> None:
    plain = bench.other.create_publisher(String, "plan", RELIABLE)
    bench.until(lambda: "--qos-durability transient_local" in bench.part("input"))
    bench.other.destroy_publisher(plain)


def test_the_wish_to_end_is_the_components(bench: Bench) -> None:
    bench.node.stop()
    assert bench.node.exit == Exit(4, "asked to")
    bench.node.close()
    assert bench.wire.sent[-1] == "closed"


def test_simulated_time_is_refused() -> None:
    with own_context() as context, pytest.raises(UserError, match="runs in real time"):
        Bench(context, use_sim_time=True)
