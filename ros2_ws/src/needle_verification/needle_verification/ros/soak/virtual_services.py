"""Services of a virtual graph: found after a while, called and answered late, or not at all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future

from needle_verification.ros.soak.virtual_endpoint import Endpoint
from needle_verification.ros.soak.virtual_topics import (
    TRANSPORT_NS,
    Careful,
    VirtualGraph,
    plainly,
)
from needle_verification.soak.link_faults import Way
from needle_verification.soak.virtual_world import VirtualProcess


class VirtualService(Endpoint):
    """rclpy's Service, as far as the nodes use it."""

    def __init__(self, graph: VirtualGraph, *place: Any, kind: type[Any], callback: Any) -> None:
        super().__init__(*place)
        self.srv_type = kind
        self.callback = callback
        self.careful: Careful = plainly
        graph.services.setdefault(self.srv_name, []).append(self)

    def answer(self, data: bytes, reply: Callable[[bytes], None]) -> None:
        """Answer a request that has come."""

        def act() -> None:
            if self.gone_ns is None:
                request = deserialize_message(data, self.srv_type.Request)
                self.careful(lambda: self._reply(request, reply))

        self.process.do(act)

    def _reply(self, request: Any, reply: Callable[[bytes], None]) -> None:
        reply(serialize_message(self.callback(request, self.srv_type.Response())))


class VirtualClient:
    """rclpy's Client, as far as the nodes use it."""

    def __init__(
        self, graph: VirtualGraph, process: VirtualProcess, kind: type[Any], name: str
    ) -> None:
        self._graph = graph
        self._process = process
        self.srv_type = kind
        self.srv_name = name
        self._way = Way(graph.world, TRANSPORT_NS, process.name, name)

    def service_is_ready(self) -> bool:
        """Return whether a server is known."""
        return bool(self._servers())

    def call_async(self, request: Any) -> Future[Any]:
        """Send a request; where the server is gone no answer ever comes."""
        graph, future = self._graph, Future()
        data = serialize_message(request)
        mark = f"{graph.world.steady_ns} {self._process.name} calls {self.srv_name} {request}\n"
        graph.digest.update(mark.encode())

        def take(answer: bytes) -> None:
            self._process.do(
                lambda: future.set_result(deserialize_message(answer, self.srv_type.Response))
            )

        def reply(answer: bytes) -> None:
            self._pass(answer, take)

        for server in self._servers():
            self._pass(data, lambda there, server=server: server.answer(there, reply))  # type: ignore[misc]
        return future

    def remove_pending_request(self, _: Future[Any]) -> None:
        """Forget a request; its answer changes nothing any more."""

    def _pass(self, data: bytes, arrive: Callable[[bytes], None]) -> None:
        world = self._graph.world
        for delivery in self._graph.faults.deliveries(self.srv_name, data, self._way):
            late_ns = self._way.takes_ns() + delivery.late_ns
            world.call_after(late_ns, lambda data=delivery.data: arrive(data))  # type: ignore[misc]

    def _servers(self) -> list[VirtualService]:
        servers = self._graph.services.get(self.srv_name, ())
        return [server for server in servers if server.is_seen(self._process)]
