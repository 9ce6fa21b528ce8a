"""A WebSocket client of live_view receives the messages that are in the bag of the run."""

from __future__ import annotations

import json
import struct
import threading
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from needle_bags.live import live_view
from needle_bags.live.live_view import FOXGLOVE, LiveView, LiveViewParameters, Watched
from needle_bags.recording.bag_tap import BagTap
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components
from needle_core import messages as m
from needle_core.component import Batch
from needle_core.errors import UserError
from needle_core.runners.paced import PacedRunner
from needle_core.runners.virtual import DIAGNOSTICS, LOG

pytest.importorskip("foxglove", reason="an extra: docs/viewers.md")
client_module = pytest.importorskip("websockets.sync.client", reason="scripts/setup console")
from needle_bags.live.foxglove_port import FoxglovePort  # noqa: E402

TIMEOUT = 20.0
# Messages in transit at the end, and before live_view is discovered.
UNDERWAY = 12
RECORDED = (
    *("/joint_states", "/needle/tip_pose", "/needle/estimate", "/needle/reduced_state"),
    *("/needle/control_input", "/needle/controller_status", "/device/status"),
)


class CountingPort(FoxglovePort):
    """Counts sent messages, and reports when all topics are watched."""

    def __init__(self, view: LiveView) -> None:
        super().__init__(0, view.channels)
        self.sent = 0
        self.all_watched = threading.Event()
        self._topics = {row.topic for row in view.channels}

    def open(self, arrive: Callable[[Batch], None]) -> None:
        def pass_on(batch: Any) -> None:
            arrive(batch)
            if any(isinstance(e, Watched) and e.topics == self._topics for e in batch):
                self.all_watched.set()

        super().open(pass_on)

    def send(self, batch: tuple[tuple[str, Any, int], ...]) -> None:
        super().send(batch)
        self.sent += len(batch)


class Client:
    """Client that subscribes to everything, and decodes it only by the advertised schemas."""

    def __init__(self, connection: Any, channels: int) -> None:
        self.received: dict[str, list[bytes]] = defaultdict(list)
        self._count = 0
        self._connection = connection
        self._channels: dict[int, dict[str, Any]] = {}
        while len(self._channels) < channels:
            message = json.loads(connection.recv(timeout=TIMEOUT))
            for channel in message.get("channels", ()):
                assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                self._channels[channel["id"]] = channel
            # Nothing that a client sends can reach the rig.
            assert message.get("capabilities", []) == []
        numbers = [{"id": number, "channelId": number} for number in self._channels]
        connection.send(json.dumps({"op": "subscribe", "subscriptions": numbers}))

    def read(self, total: int) -> None:
        while self._count < total:
            data = self._connection.recv(timeout=TIMEOUT)
            kind, number, _ = struct.unpack_from("<BIQ", data)
            assert kind == 1
            self.received[self._channels[number]["topic"]].append(data[13:])
            self._count += 1

    def decoded(self, topic: str) -> list[Any]:
        (channel,) = (c for c in self._channels.values() if c["topic"] == topic)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
        return [store.deserialize_cdr(d, channel["schemaName"]) for d in self.received[topic]]


def connected(port: FoxglovePort) -> Any:
    uri = f"ws://127.0.0.1:{port.port}"
    return client_module.connect(uri, subprotocols=["foxglove.sdk.v1"], proxy=None)


def test_a_client_reads_what_the_bag_has_and_where_the_needle_is(tmp_path: Path) -> None:
    view = LiveView(LiveViewParameters(foxglove_port=1), transforms=False)
    options = parse(["--level", "tip", "--depth-mm", "3"])
    components = [*make_components(command_line_parameters(options, tmp_path / "bag")), view]
    port = CountingPort(view)
    tap = BagTap(tmp_path / "bag", components, (DIAGNOSTICS, LOG), {})
    runner = PacedRunner(components, 1, pace=1e9, ports={FOXGLOVE: port}, taps=[tap])
    with connected(port) as connection:
        client = Client(connection, len(view.channels))
        assert port.all_watched.wait(TIMEOUT)
        while not runner.run(0.2):
            client.read(port.sent)
        client.read(port.sent)
    runner.close()
    tap.close()
    sent = defaultdict(list)
    with AnyReader([tmp_path / "bag"]) as reader:
        for topic, _, data in reader.messages():
            sent[topic.topic].append(bytes(data))
    for name in RECORDED:
        received = client.received[name]
        assert received
        assert len(sent[name]) - len(received) <= UNDERWAY
        first = sent[name].index(received[0])
        assert received == sent[name][first : first + len(received)]
    assert all(client.decoded(topic) for topic in client.received)
    moving = {one.child_frame_id for message in client.decoded("/tf") for one in message.transforms}
    assert moving == {"target_plane", "needle_tip", "carriage", "shaft"}


def test_a_late_client_receives_latched_messages_and_the_end_is_reported() -> None:
    view = LiveView(LiveViewParameters(foxglove_port=1), transforms=False)
    port = FoxglovePort(0, view.channels)
    events: list[Any] = []
    port.open(events.append)
    with pytest.raises(UserError, match=rf"cannot listen at 127\.0\.0\.1, port {port.port}: "):
        FoxglovePort(port.port, view.channels).open(events.append)
    for text in ("old", "new"):
        port.send(((live_view.ROBOT_DESCRIPTION, m.Text(text), 7),))
    port.send((("joint_states", m.JointState(1, (), ()), 8),))
    with connected(port) as connection:
        client = Client(connection, len(view.channels))
        client.read(1)
        assert [one.data for one in client.decoded("/robot_description")] == ["new"]
    port.close()
    assert events[-1] == (Watched(frozenset()),)
