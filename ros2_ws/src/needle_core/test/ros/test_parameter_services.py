"""Parameters that others set: whole, typed and within bounds, or not at all; and stamps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_core.ros.conversions import to_nanoseconds, to_stamp
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
    """Has a parameter."""

    def __init__(self, context: Any) -> None:
        super().__init__(
            "listener",
            context=context,
            parameter_overrides=[Parameter("use_sim_time", value=True)],
        )
        self.parameters = NodeParameters(self, Settings)


class Bench:
    """A listener, and who asks it."""

    def __init__(self, context: Any) -> None:
        self.listener, self.sender = Listener(context), Node("sender", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        for node in (self.listener, self.sender):
            self.executor.add_node(node)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < end, f"timed out: {what}"
            self.executor.spin_once(timeout_sec=0.01)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.sender.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(request)
        self.until(future.done, name)
        return future.result()

    def close(self) -> None:
        self.executor.shutdown()
        self.listener.destroy_node()
        self.sender.destroy_node()


@pytest.fixture
def bench() -> Iterator[Bench]:
    with own_context() as context:
        bench = Bench(context)
        yield bench
        bench.close()


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
