"""Port of live_view: a WebSocket server for Foxglove, without any ROS package."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener
from rosbags.typesys import Stores, get_typestore

from needle_bags.live.live_view import Watched
from needle_core.component import Batch, Log, Output
from needle_core.convert import ros_type, to_ros
from needle_core.errors import UserError
from needle_core.message_types import rosbags_types
from needle_core.settings.parameter_files import absolute_name

_LOOPBACK = "127.0.0.1"


class FoxglovePort(ServerListener):
    """The real port of `LiveView`: serves its topics as ROS 2 messages; clients cannot send any.

    Parameters
    ----------
    port : int
        Port on loopback; 0 for any free port.
    channels : iterable of Output
        Topics to serve; a new subscriber receives the last message of a latched topic.

    Attributes
    ----------
    port : int
        The port in use, once open.
    """

    def __init__(self, port: int, channels: Iterable[Output]) -> None:
        self.port = port
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._types = rosbags_types(self._store)
        self._context = foxglove.Context()
        self._rows = {row.topic: row for row in channels}
        self._channels = {topic: self._channel(row) for topic, row in self._rows.items()}
        self._latched: dict[str, tuple[bytes, int]] = {}

    def open(self, arrive: Callable[[Batch], None]) -> None:
        """Start the server; `arrive` receives its events.

        Raises
        ------
        UserError
            If the port is not available.
        """
        self._arrive = arrive
        try:
            self._server = foxglove.start_server(
                name="needle",
                host=_LOOPBACK,
                port=self.port,
                capabilities=[],
                server_listener=self,
                context=self._context,
            )
        except RuntimeError as error:
            raise UserError(f"cannot listen at {_LOOPBACK}, port {self.port}: {error}") from error
        self.port = self._server.port
        arrive((Log("info", f"Foxglove: open the connection ws://localhost:{self.port}"),))

    def send(self, batch: tuple[tuple[str, Any, int], ...]) -> None:
        """Send topics, messages and times [ns]; a slow client misses old messages."""
        for topic, message, stamp_ns in batch:
            ros_message = to_ros(message, self._types)
            data = bytes(self._store.serialize_cdr(ros_message, ros_type(type(message))))
            if self._rows[topic].delivery.latched:
                self._latched[topic] = data, stamp_ns
            self._channels[topic].log(data, log_time=stamp_ns)

    def close(self) -> None:
        """Disconnect all clients."""
        self._server.stop()

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Report the subscription, and send the last message of a latched topic."""
        self._report()
        name = channel.topic
        for topic, (data, stamp_ns) in tuple(self._latched.items()):
            if absolute_name(topic) == name:
                self._channels[topic].log(data, log_time=stamp_ns)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """Report the end of a subscription."""
        self._report()

    def _report(self) -> None:
        watched = (topic for topic, channel in self._channels.items() if channel.has_sinks())
        self._arrive((Watched(frozenset(watched)),))

    def _channel(self, row: Output) -> foxglove.Channel:
        name = ros_type(row.message)
        definition, _ = self._store.generate_msgdef(name, ros_version=2)
        schema = foxglove.Schema(name=name, encoding="ros2msg", data=definition.encode())
        return foxglove.Channel(
            absolute_name(row.topic), schema=schema, message_encoding="cdr", context=self._context
        )
