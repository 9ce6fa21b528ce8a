"""A process that answers for the parameters of a node that has no time."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter

from needle_core.process.ros_domain import own_domain
from needle_core.ros.parameter_desk import ParameterDesk
from needle_core.ros.parameters import NodeParameters
from needle_core.settings.parameter_fields import fixed_parameter
from own_context import own_context

LIMIT = 30.0


@dataclasses.dataclass(frozen=True)
class Settings:
    """Fixed."""

    rate: float = fixed_parameter(30.0, "Hz", "A rate.", 1.0, 100.0)
    names: tuple[str, ...] = fixed_parameter(("a", "b"), "-", "Names.")


class Bench:
    """A node that never spins, its desk, and who asks."""

    def __init__(self, context: Any) -> None:
        self.busy = Node(
            "busy",
            namespace="/rig",
            context=context,
            start_parameter_services=False,
            parameter_overrides=[Parameter("rate", value=50.0)],
        )
        NodeParameters(self.busy, Settings)
        self.desk = ParameterDesk(self.busy, f"{__name__.rpartition('.')[2]}:Settings")
        self.asker = Node("asker", context=context)
        self._executor = SingleThreadedExecutor(context=context)
        self._executor.add_node(self.asker)

    def ask(self, kind: Any, name: str, **request: Any) -> Any:
        client = self.asker.create_client(kind, f"/rig/busy/{name}")
        assert client.wait_for_service(LIMIT)
        future = client.call_async(kind.Request(**request))
        end = time.monotonic() + LIMIT
        while not future.done():
            assert time.monotonic() < end, name
            self._executor.spin_once(timeout_sec=0.05)
        return future.result()

    def close(self) -> None:
        self.desk.close()
        self._executor.shutdown()
        self.busy.destroy_node()
        self.asker.destroy_node()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    with own_context() as context:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(context.get_domain_id()))
        monkeypatch.setenv("PYTHONPATH", _path())
        bench = Bench(context)
        assert bench.desk.ready(LIMIT)
        yield bench
        bench.close()


def _path() -> str:
    return ":".join([__file__.rpartition("/")[0], *filter(None, sys.path)])


def test_it_answers_for_a_node_that_never_spins(bench: Bench) -> None:
    assert {"rate", "names", "use_sim_time"} <= set(
        bench.ask(ListParameters, "list_parameters").result.names
    )
    rate, names = bench.ask(GetParameters, "get_parameters", names=["rate", "names"]).values
    assert rate.double_value == 50.0
    assert list(names.string_array_value) == ["a", "b"]
    (told,) = bench.ask(DescribeParameters, "describe_parameters", names=["rate"]).descriptors
    assert (told.description, told.read_only) == ("A rate.", True)


def test_what_is_fixed_cannot_be_set_however_long_the_request_is(bench: Bench) -> None:
    given = [Parameter("rate", value=60.0).to_parameter_msg()] * 2000
    results = bench.ask(SetParameters, "set_parameters", parameters=given).results
    assert len(results) == 2000
    assert not any(result.successful for result in results)
    (rate,) = bench.ask(GetParameters, "get_parameters", names=["rate"]).values
    assert rate.double_value == 50.0


def test_one_that_a_signal_ended_at_its_start_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Ended(subprocess.Popen[bytes]):
        def __init__(self, _: list[str], **how: Any) -> None:
            super().__init__(["true"], **how)
            self.wait(LIMIT)

    monkeypatch.setattr(subprocess, "Popen", Ended)
    with own_context() as context:
        node = Node("short", context=context, start_parameter_services=False)
        desk = ParameterDesk(node, "nowhere:Settings")
        assert desk.ready(LIMIT)
        desk.close()
        node.destroy_node()


def test_it_ends_with_whoever_started_it() -> None:
    with own_domain() as domain:
        words = [
            "-m",
            "needle_core.ros.parameter_desk",
            "/",
            "gone",
            "test_parameter_desk:Settings",
        ]
        with subprocess.Popen(
            [sys.executable, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": _path()},
        ) as process:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(b"{}\n")
            process.stdin.flush()
            assert process.stdout.readline() == b"ready\n"
            process.stdin.close()
            assert process.wait(LIMIT) == 0
