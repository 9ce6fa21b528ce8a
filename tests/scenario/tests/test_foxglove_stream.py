"""Data that a WebSocket client of live_view decodes during a run agree with the bag of the run."""

from __future__ import annotations

import json
import struct
import threading
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from needle_bags.live import live_view
from needle_bags.live.live_view import FOXGLOVE, LiveView, LiveViewParameters, Watched
from needle_bags.live.rig_model import rig_urdf
from needle_bags.recording.bag_tap import BagTap
from needle_bringup.simulated_operator.component import SimulatedOperator
from needle_bringup.simulation.rig_configuration import command_line_parameters
from needle_bringup.simulation.simulate_options import parse
from needle_bringup.simulation.virtual_run import make_components
from needle_core import messages as m
from needle_core.component import LATCHED, Batch, Component, Output, Publish, Timer
from needle_core.convert import from_ros
from needle_core.errors import UserError
from needle_core.runners.paced import PacedRunner
from needle_core.runners.virtual import DIAGNOSTICS, LOG
from needle_device_driver.supervisor.limits import SafetyLimits
from needle_tracker.optics.calibration import load_calibration

pytest.importorskip("foxglove", reason="an extra: docs/viewers.md")
client_module = pytest.importorskip("websockets.sync.client", reason="scripts/setup console")
from needle_bags.live.foxglove_port import FoxglovePort  # noqa: E402

CALIBRATION = Path(__file__).parents[3] / "ros2_ws/src/needle_tracker/config/calibration.yaml"
TIMEOUT = 20.0
TIP_POSE = "/needle/tip_pose"
# Messages in transit at the end, and before live_view is discovered.
UNDERWAY = 12


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


class CalibrationSource(Component):
    """Publishes the calibration repeatedly, as a restarting tracker does."""

    name = "calibration_source"
    outputs = (Output("stereo_tracker/calibration", m.Text, LATCHED),)

    def __init__(self) -> None:
        text = m.Text(CALIBRATION.read_text("utf-8"))
        self.timers = (Timer(2.0, lambda _: [Publish(self.outputs[0].topic, text)]),)


class Client:
    """Client that subscribes to everything, and decodes it only by the advertised schemas."""

    def __init__(self, connection: Any) -> None:
        self.received: dict[str, list[bytes]] = defaultdict(list)
        self.count = 0
        self._connection = connection
        self._channels: dict[int, dict[str, Any]] = {}

    def subscribe(self, channels: int) -> None:
        while len(self._channels) < channels:
            message = json.loads(self._connection.recv(timeout=TIMEOUT))
            for channel in message.get("channels", ()):
                assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                self._channels[channel["id"]] = channel
            # Nothing that a client sends can reach the rig.
            assert message.get("capabilities", []) == []
        numbers = [{"id": number, "channelId": number} for number in self._channels]
        self._connection.send(json.dumps({"op": "subscribe", "subscriptions": numbers}))

    def read(self, total: int) -> None:
        while self.count < total:
            data = self._connection.recv(timeout=TIMEOUT)
            kind, number, _ = struct.unpack_from("<BIQ", data)
            assert kind == 1
            self.received[self._channels[number]["topic"]].append(data[13:])
            self.count += 1

    def decoded(self, topic: str) -> list[Any]:
        (channel,) = (c for c in self._channels.values() if c["topic"] == topic)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
        return [store.deserialize_cdr(d, channel["schemaName"]) for d in self.received[topic]]

    def messages(self, kind: type[Any], topic: str) -> list[Any]:
        return [from_ros(kind, message) for message in self.decoded(topic)]


@pytest.fixture(scope="module")
def stream_and_bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Client, dict[str, Any]]:
    """Return what a client received during an insertion of 3 mm, and the bag's payloads."""
    bag = tmp_path_factory.mktemp("stream") / "bag"
    options = parse(["--level", "tip", "--depth-mm", "3"])
    view = LiveView(LiveViewParameters(foxglove_port=1), transforms=False)
    rig = make_components(command_line_parameters(options, bag))
    components = [*rig, view, CalibrationSource()]
    port = CountingPort(view)
    tap = BagTap(bag, components, (DIAGNOSTICS, LOG), {})
    runner = PacedRunner(components, 1, pace=1e9, ports={FOXGLOVE: port}, taps=[tap])
    uri = f"ws://127.0.0.1:{port.port}"
    with client_module.connect(uri, subprotocols=["foxglove.sdk.v1"], proxy=None) as connection:
        client = Client(connection)
        client.subscribe(len(view.channels))
        assert port.all_watched.wait(TIMEOUT)
        while not runner.run(0.2):
            client.read(port.sent)
        client.read(port.sent)
    runner.close()
    tap.close()
    assert list(runner.exits) == [SimulatedOperator.name]
    recorded = defaultdict(list)
    with AnyReader([bag]) as reader:
        for topic, _, data in reader.messages():
            recorded[topic.topic].append(bytes(data))
    return client, recorded


@pytest.mark.parametrize(
    "topic",
    [
        "/joint_states",
        "/needle/tip_pose",
        "/needle/estimate",
        "/needle/reduced_state",
        "/needle/control_input",
        "/needle/controller_status",
        "/device/status",
        "/robot_description",
    ],
)
def test_the_rig_s_topics_are_those_of_the_bag(
    stream_and_bag: tuple[Client, dict[str, Any]], topic: str
) -> None:
    client, recorded = stream_and_bag
    received, sent = client.received[topic], recorded[topic]
    assert received
    assert len(sent) - len(received) <= UNDERWAY
    first = sent.index(received[0])
    assert received == sent[first : first + len(received)]


def test_health_of_all_nodes_arrives(stream_and_bag: tuple[Client, dict[str, Any]]) -> None:
    client, recorded = stream_and_bag
    received = Counter(client.received["/diagnostics"])
    assert received <= Counter(recorded["/diagnostics"])
    sources = {s.hardware_id for one in client.decoded("/diagnostics") for s in one.status}
    assert {"sim_rig", "plane_controller", "simulated_operator"} <= sources


def test_the_view_of_the_needle_agrees_with_the_bag(
    stream_and_bag: tuple[Client, dict[str, Any]],
) -> None:
    client, _ = stream_and_bag
    moving = {one.child_frame_id for message in client.decoded("/tf") for one in message.transforms}
    assert moving == {"target_plane", "needle_tip", "carriage", "shaft"}
    tips = {(tip.stamp_ns, tip.position) for tip in client.messages(m.PoseWithCovariance, TIP_POSE)}
    assert {(p.stamp_ns, p.position) for p in client.messages(m.Pose, "/live_view/tip")} <= tips
    ends = [p.positions[-1] for p in client.messages(m.Path, "/live_view/path") if p.positions]
    for message in client.messages(m.Markers, "/live_view/markers"):
        ends += [
            one.points[-1] for one in message.markers if one.namespace == "shaft" and one.points
        ]
    entry = (0.0, 0.0, 0.0)
    assert set(ends) <= {entry, *(position for _, position in tips)}
    assert len(ends) > 20
    urdf = rig_urdf(load_calibration(CALIBRATION), SafetyLimits(), 0.0007)
    assert {one.data for one in client.decoded("/robot_description")} == {urdf}
    frames = {t.child_frame_id for t in client.decoded("/tf_static")[-1].transforms}
    assert {"left_camera_optical", "right_camera_optical", "stage"} <= frames


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
    uri = f"ws://127.0.0.1:{port.port}"
    with client_module.connect(uri, subprotocols=["foxglove.sdk.v1"], proxy=None) as connection:
        client = Client(connection)
        client.subscribe(len(view.channels))
        client.read(1)
        assert [one.data for one in client.decoded("/robot_description")] == ["new"]
    port.close()
    assert events[-1] == (Watched(frozenset()),)
