"""Whatever a node is sent, it goes on and says what it could not use."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from needle_core.errors import UserError
from needle_core.ros.base_node import DiagnosticsPublisher, executor_of
from needle_core.ros.conversions import RELIABLE, to_nanoseconds, to_stamp, values_of
from needle_core.ros.parameters import NodeParameters
from needle_core.settings.parameter_fields import parameter
from own_context import own_context

LIMIT = 20.0
NO_TYPE = 11


@dataclasses.dataclass(frozen=True)
class Settings:
    """One."""

    rate: float = parameter(30.0, unit="Hz", lower=1.0, upper=100.0, description="A rate.")


class Listener(Node):
    """Fails on what it does not like."""

    def __init__(self, context: Any) -> None:
        super().__init__(
            "listener",
            context=context,
            parameter_overrides=[Parameter("use_sim_time", value=True)],
        )
        self.heard: list[str] = []
        self.parameters = NodeParameters(self, Settings)
        self.diagnostics = DiagnosticsPublisher(self)
        self.create_subscription(Header, "numbers", self._on_number, RELIABLE)
        self.create_service(Trigger, "fail", self._fail)

    def _on_number(self, message: Header) -> None:
        if message.frame_id == "end":
            raise UserError("the end")
        int(message.frame_id)
        self.heard.append(message.frame_id)

    def _fail(self, _: Any, response: Any) -> Any:
        raise RuntimeError("no answer")


class Bench:
    """A listener on an executor of its own kind, and who sends to it."""

    def __init__(self, context: Any) -> None:
        self.listener = Listener(context)
        self.failures: list[str] = []
        self.executor = executor_of(self.listener, self.failures.append)
        self.sender = Node("sender", context=context)
        self._own = SingleThreadedExecutor(context=context)
        self._own.add_node(self.sender)
        self.input: dict[str, str] = {}
        self.message = ""
        self.sender.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, RELIABLE
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == "listener: input":
                self.message, self.input = status.message, values_of(status)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f"timed out: {what}; {self.message} {self.input}"
            self.executor.spin_once(timeout_sec=0.01)
            self._own.spin_once(timeout_sec=0.01)

    def publisher(self, kind: type, topic: str) -> Any:
        publisher = self.sender.create_publisher(kind, topic, RELIABLE)
        self.until(lambda: publisher.get_subscription_count() > 0, topic)
        return publisher

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.sender.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        self.until(future.done, name)
        return future.result()

    def close(self) -> None:
        self.executor.shutdown()
        self._own.shutdown()
        self.listener.destroy_node()
        self.sender.destroy_node()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context)
        yield bench
        bench.close()


def test_a_message_that_a_callback_fails_on_is_named_counted_and_ends_nothing(bench: Bench) -> None:
    numbers = bench.publisher(Header, "numbers")
    for text in ("1", "two", "three", "4"):
        numbers.publish(Header(frame_id=text))
    bench.until(lambda: bench.listener.heard == ["1", "4"], "what can be used")
    bench.until(lambda: bench.input.get("refused numbers") == "2", "the count")
    assert bench.message == "numbers: refused: ValueError"
    assert "'three'" in bench.input["last"]
    assert len(bench.failures) == 2


def test_bytes_that_are_no_message_reach_no_callback(bench: Bench) -> None:
    numbers = bench.publisher(Header, "numbers")
    # a CDR header, a stamp, and a string that is longer than what there is
    numbers.publish(b"\0\1\0\0" + bytes(8) + b"\xff\0\0\0a\0")
    numbers.publish(Header(frame_id="5"))
    bench.until(lambda: bench.listener.heard == ["5"], "what can be used")
    assert not bench.failures


def test_a_user_error_still_ends_the_node(bench: Bench) -> None:
    numbers = bench.publisher(Header, "numbers")
    numbers.publish(Header(frame_id="end"))
    with pytest.raises(UserError, match="the end"):
        bench.until(lambda: False, "the end")


def test_a_negative_clock_is_refused_and_time_goes_on(bench: Bench) -> None:
    clock = bench.publisher(Clock, "/clock")
    clock.publish(Clock(clock=Time(sec=-1)))
    bench.until(lambda: bench.input.get("refused /clock") == "1", "the refusal")
    clock.publish(Clock(clock=Time(sec=7)))
    bench.until(lambda: bench.listener.get_clock().now().nanoseconds == 7_000_000_000, "the time")


def test_the_last_time_that_a_clock_can_tell_ends_nothing(bench: Bench) -> None:
    clock = bench.publisher(Clock, "/clock")
    clock.publish(Clock(clock=Time(sec=2**31 - 1, nanosec=2**32 - 1)))
    last_ns = to_nanoseconds(Time(sec=2**31 - 1, nanosec=2**32 - 1))
    bench.until(lambda: bench.listener.get_clock().now().nanoseconds == last_ns, "the time")
    bench.listener.diagnostics.refuse("a", "b", "c")
    bench.until(lambda: bench.input.get("refused a") == "1", "what is said then")


def test_a_service_that_fails_is_named_and_ends_nothing(bench: Bench) -> None:
    client = bench.sender.create_client(Trigger, "fail")
    bench.until(client.service_is_ready, "the service")
    client.call_async(Trigger.Request())
    bench.until(lambda: bench.input.get("refused fail") == "1", "the refusal")


@pytest.mark.parametrize("kind", [SetParameters, SetParametersAtomically])
def test_a_parameter_of_no_type_is_refused_with_all_beside_it(bench: Bench, kind: Any) -> None:
    good = Parameter("rate", value=50.0).to_parameter_msg()
    bad = ParameterMessage(name="rate", value=ParameterValue(type=NO_TYPE))
    response = bench.call(kind, f"listener/{_snake(kind)}", kind.Request(parameters=[good, bad]))
    results = response.results if kind is SetParameters else [response.result]
    assert not any(result.successful for result in results)
    assert all(result.reason == "rate: there is no parameter type 11" for result in results)
    assert bench.listener.parameters.values.rate == 30.0


def test_use_sim_time_is_fixed_at_start(bench: Bench) -> None:
    for value, accepted in ((False, False), (True, True)):
        request = SetParameters.Request(
            parameters=[Parameter("use_sim_time", value=value).to_parameter_msg()]
        )
        (result,) = bench.call(SetParameters, "listener/set_parameters", request).results
        assert result.successful is accepted
    assert bench.listener.get_clock().ros_time_is_active
    assert bench.listener.get_parameter("use_sim_time").value is True


@pytest.mark.parametrize("sec", [-(2**31), -1, 0, 1, 2**31 - 1])
@pytest.mark.parametrize("nanosec", [0, 1, 999_999_999, 10**9, 2**32 - 1])
def test_every_stamp_has_a_time_and_every_time_a_stamp(sec: int, nanosec: int) -> None:
    time_ns = to_nanoseconds(Time(sec=sec, nanosec=nanosec))
    assert to_nanoseconds(to_stamp(time_ns)) == time_ns
    for beyond in (time_ns * 3, time_ns - 10**10, time_ns + 10**10):
        to_stamp(beyond)


def _snake(kind: Any) -> str:
    return "set_parameters" if kind is SetParameters else "set_parameters_atomically"
