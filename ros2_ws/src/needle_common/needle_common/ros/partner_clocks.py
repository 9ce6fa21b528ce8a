"""Clocks of other computers: asked for once a second, told where they differ from this one's.

Stamps of two computers can be compared only where their clocks agree. Which they do is no matter of
belief: any node answers a question, and DDS stamps the answer by the clock of who gives it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import qos_profile_services_default
from rclpy.waitable import NumberOfEntities, Waitable
from type_description_interfaces.srv import GetTypeDescription

from needle_common.diagnostics import Diagnostic, Level
from needle_common.process.clock_offset import ClockOffset, ClockReadings
from needle_common.process.reach import is_open
from needle_common.ros.base_node import STEADY_CLOCK, DiagnosticsPublisher
from needle_common.ros.discovery import NO_TYPE, known_publishers_of

PART = "clocks"
# A needle at 5 mm/s goes 0.05 mm in it: beside what else is not known of a tip it does not count.
BOUND = 0.01
_SPEED = 5.0  # [mm/s]
_PERIOD = 1.0
_MOST_PENDING = 10


class PartnerClocks:
    """Watches the clocks of those whose stamps a node compares.

    On one machine there is one clock, and in simulated time none counts: nobody is asked then.

    Parameters
    ----------
    node : Node
        The node that compares.
    diagnostics : DiagnosticsPublisher
        Where what is found goes, as part `clocks`.
    topics : iterable of str
        What it hears with stamps of others.
    now_ns : callable
        This computer's clock [ns].
    """

    def __init__(
        self,
        node: Node,
        diagnostics: DiagnosticsPublisher,
        topics: Iterable[str],
        now_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._node = node
        self._diagnostics = diagnostics
        self._topics = tuple(topics)
        self._now_ns = now_ns
        self._asked: dict[str, _AskedClock] = {}
        self._told = Level.OK
        if not is_open() or node.get_parameter("use_sim_time").value:
            diagnostics.set(PART, Diagnostic(Level.OK, "one clock"))
            return
        node.create_timer(_PERIOD, self._look, clock=STEADY_CLOCK)

    def _look(self) -> None:
        names = {name for topic in self._topics for name in known_publishers_of(self._node, topic)}
        for name in self._asked.keys() - names:
            self._asked.pop(name).close()
        for name in names - self._asked.keys():
            self._asked[name] = _AskedClock(self._node, name, self._now_ns)
        now_ns = self._now_ns()
        health = judge({name: asked.best(now_ns) for name, asked in self._asked.items()})
        self._diagnostics.set(PART, health)
        if health.level != self._told and health.level is not Level.OK:
            self._node.get_logger().warning(health.message)
        self._told = health.level
        for asked in self._asked.values():
            asked.ask()


def judge(offsets: Mapping[str, ClockOffset | None]) -> Diagnostic:
    """Return what is to be said of the clocks of other nodes; None: it has not answered."""
    values, wrong = {}, []
    for name, offset in sorted(offsets.items()):
        values[f"{name} ahead_s"] = "" if offset is None else f"{offset.ahead:.4f}"
        values[f"{name} within_s"] = "" if offset is None else f"{offset.within:.4f}"
        if offset is not None and offset.least_difference > BOUND:
            side = "ahead of" if offset.ahead > 0.0 else "behind"
            wrong.append(
                f"the clock of {name} is {abs(offset.ahead):.3f} s (+-{offset.within:.3f} s) "
                f"{side} this computer's: {abs(offset.ahead) * _SPEED:.2g} mm at {_SPEED:g} mm/s"
            )
    if wrong:
        way_out = "set both by one server (docs/two_computers.md)"
        return Diagnostic(Level.WARN, f"{'; '.join(wrong)}; {way_out}", values)
    silent = [name for name, offset in sorted(offsets.items()) if offset is None]
    if silent:
        return Diagnostic(Level.OK, f"no answer yet from {', '.join(silent)}", values)
    return Diagnostic(Level.OK, f"within {BOUND:g} s, as far as can be told", values)


class _AskedClock(Waitable):
    """The clock of one node, asked by a service that every node has.

    rclpy's own client does not tell when an answer was sent.
    """

    def __init__(self, node: Node, name: str, now_ns: Callable[[], int]) -> None:
        super().__init__(node.default_callback_group)
        self._node = node
        self._now_ns = now_ns
        self._pending: dict[int, int] = {}
        self._readings = ClockReadings()
        self._index = 0
        with node.handle:
            self._client = rclpy_implementation.Client(
                node.handle,
                GetTypeDescription,
                f"{name}/get_type_description",
                qos_profile_services_default.get_c_qos_profile(),
            )
        node.add_waitable(self)

    def close(self) -> None:
        """Ask no more."""
        self._node.remove_waitable(self)
        self._client.destroy_when_not_in_use()

    def ask(self) -> None:
        """Ask for the time, where the node is there."""
        with self._client:
            if not self._client.service_server_is_available():
                return
            asked_ns = self._now_ns()
            self._pending[self._client.send_request(NO_TYPE)] = asked_ns
        while len(self._pending) > _MOST_PENDING:
            del self._pending[min(self._pending)]

    def best(self, now_ns: int) -> ClockOffset | None:
        """Return what the last answers tell."""
        return self._readings.best(now_ns)

    # ---- what an executor wants of it ---------------------------------------------------------

    def __enter__(self) -> None:
        self._client.__enter__()

    def __exit__(self, *what: object) -> None:
        self._client.__exit__(*what)

    def get_num_entities(self) -> NumberOfEntities:
        return NumberOfEntities(num_clients=1)

    def add_to_wait_set(self, wait_set: Any) -> None:
        self._index = wait_set.add_client(self._client)

    def is_ready(self, wait_set: Any) -> bool:
        return bool(wait_set.is_ready("client", self._index))

    def take_data(self) -> Any:
        with self._client:
            header, _ = self._client.take_response(GetTypeDescription.Response)
        return header

    async def execute(self, header: Any) -> None:
        if header is None:
            return
        asked_ns = self._pending.pop(header.request_id.sequence_number, None)
        if asked_ns is not None:
            self._readings.add(asked_ns, header.source_timestamp, self._now_ns())
