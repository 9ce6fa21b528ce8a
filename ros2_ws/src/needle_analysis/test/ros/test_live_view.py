"""live_view before a graph that the test plays, and the viewers' files that show it."""

from __future__ import annotations

import array
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CompressedImage, Image, JointState
from std_msgs.msg import String
from visualization_msgs.msg import Marker, MarkerArray

from needle_analysis.ros import live_view
from needle_analysis.ros.live_view import OUTPUTS, LiveViewNode
from needle_bags.format.message_definitions import message_class
from needle_core.ros.base_node import executor_of
from needle_core.ros.conversions import IMAGES, JOINT_STATES, LATCHED, RELIABLE, to_stamp
from needle_tracker.optics.calibration import load_calibration
from needle_tracker.optics.refraction import stereo_views
from own_context import own_context

ROOT = Path(__file__).parents[5]
CONFIG = ROOT / "ros2_ws/src/needle_analysis/config"
CALIBRATION = ROOT / "ros2_ws/src/needle_tracker/config/calibration.yaml"
LIMIT = 20.0
TIP = [0.001, 0.002, 0.04]


class PlayedGraph(Node):
    """Says what tracker, controller and device say; looks like a viewer."""

    def __init__(self, context: Context) -> None:
        super().__init__("played_graph", context=context)
        self.heard: dict[str, list[Any]] = {topic: [] for topic in OUTPUTS}
        pose = PoseWithCovarianceStamped
        self._send = {
            topic: self.create_publisher(kind, topic, qos)
            for topic, kind, qos in (
                ("joint_states", JointState, JOINT_STATES),
                ("needle/tip_pose", pose, RELIABLE),
                ("needle/estimate", pose, RELIABLE),
                ("needle/controller_status", DiagnosticStatus, LATCHED),
                ("target_plane", PoseStamped, RELIABLE),
                ("stereo_tracker/calibration", String, LATCHED),
                ("stereo/left/image_raw", Image, IMAGES),
            )
        }

    def say(self, topic: str, message: Any) -> None:
        self._send[topic].publish(message)

    def hearers(self, topic: str) -> int:
        return int(self._send[topic].get_subscription_count())

    def look_at(self, topic: str) -> None:
        name = topic.replace("~", "live_view")
        self.create_subscription(OUTPUTS[topic], name, self.heard[topic].append, RELIABLE)

    def pose(self, frame: str, sigma: float, stamp_ns: int) -> PoseWithCovarianceStamped:
        message = PoseWithCovarianceStamped()
        message.header.stamp, message.header.frame_id = to_stamp(stamp_ns), frame
        p = message.pose.pose.position
        p.x, p.y, p.z = TIP
        message.pose.pose.orientation.w = 1.0
        message.pose.covariance = np.diag(np.full(6, sigma**2)).ravel()
        return message


class Scene:
    def __init__(self, context: Context) -> None:
        self.graph = PlayedGraph(context)
        self.view = LiveViewNode(context)
        self._played = SingleThreadedExecutor(context=context)
        self._played.add_node(self.graph)
        self._viewed = executor_of(self.view)

    def until(self, condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < deadline
            self.look()

    def look(self) -> None:
        for executor in (self._played, self._viewed):
            executor.spin_once(timeout_sec=0.005)

    def last(self, topic: str, condition: Callable[[Any], object]) -> Any:
        """Wait for a message of the live view of which a condition holds; return it."""
        heard = self.graph.heard[topic]
        self.until(lambda: heard and condition(heard[-1]))
        return heard[-1]

    def close(self) -> None:
        self._played.shutdown()
        self._viewed.shutdown()
        self.view.destroy_node()
        self.graph.destroy_node()


@pytest.fixture
def scene() -> Iterator[Scene]:
    with own_context() as context:
        one = Scene(context)
        yield one
        one.close()


def shown(markers: MarkerArray) -> dict[str, Marker]:
    return {marker.ns: marker for marker in markers.markers if marker.action == Marker.ADD}


def test_the_needle_is_shown_to_who_looks(scene: Scene) -> None:
    graph = scene.graph
    scene.until(lambda: graph.hearers("needle/tip_pose") and graph.hearers("joint_states"))
    graph.say("joint_states", JointState(name=["insertion_joint"], position=[0.04]))
    values = {"target_offset_m": "0.003", "target_point_m": "0.01, 0.0, 0.1"}
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    graph.say("needle/controller_status", DiagnosticStatus(values=pairs))
    for topic in ("~/markers", "~/tip", "~/path"):
        graph.look_at(topic)
    seen = scene.last("~/markers", lambda m: "target_point" in shown(m))
    assert set(shown(seen)) == {"plane", "target_point"}
    graph.say("needle/tip_pose", graph.pose("rig", 1e-4, 5_000_000_000))
    seen = shown(scene.last("~/markers", lambda m: "shaft" in shown(m)))
    end = seen["shaft"].points[-1]
    assert [end.x, end.y, end.z] == TIP
    assert seen["uncertainty"].scale.x == pytest.approx(2 * 2.7955e-4)
    assert seen["plane"].pose.position.x == pytest.approx(0.003)
    assert seen["plane"].header.frame_id == "rig"
    tip = scene.last("~/tip", lambda _: True)
    assert (tip.header.frame_id, tip.header.stamp.sec) == ("rig", 5)
    assert len(scene.last("~/path", lambda m: len(m.poses) > 1).poses) == 2
    # In the frame of the plane, 3 mm beside.
    graph.say("needle/estimate", graph.pose("target_plane", 2e-4, 5_000_000_000))
    seen = shown(scene.last("~/markers", lambda m: "estimate" in shown(m)))
    assert seen["estimate"].points[0].x == pytest.approx(TIP[0] + 0.003)
    assert seen["uncertainty"].scale.x == pytest.approx(4 * 2.7955e-4)
    # What is not found is grey, what cannot be a pose changes nothing.
    graph.say("needle/tip_pose", graph.pose("rig", np.inf, 6_000_000_000))
    scene.last("~/markers", lambda m: shown(m)["tip"].color.r == pytest.approx(0.7))
    graph.say("target_plane", PoseStamped())
    for sigma in (np.nan, 1e150):
        graph.say("needle/estimate", graph.pose("target_plane", sigma, 7_000_000_000))
    graph.say("joint_states", JointState(name=["insertion_joint"], position=[1e300]))
    for key, text in (
        ("target_point_m", "0.1, 0.2"),
        ("target_offset_m", "nan"),
        ("target_offset_m", "far"),
    ):
        pair = KeyValue(key=key, value=text)
        graph.say("needle/controller_status", DiagnosticStatus(values=[pair]))
    markers = graph.heard["~/markers"]
    count = len(markers)
    scene.until(lambda: len(markers) > count + 3)
    assert shown(markers[-1])["estimate"].points[0].x == pytest.approx(TIP[0] + 0.003)
    assert not graph.heard["~/left/compressed"]


def test_images_are_heard_and_drawn_only_while_somebody_looks(scene: Scene) -> None:
    graph = scene.graph
    scene.until(lambda: graph.hearers("needle/tip_pose") and graph.hearers("joint_states"))
    graph.say("stereo_tracker/calibration", String(data=CALIBRATION.read_text("utf-8")))
    graph.say("joint_states", JointState(name=["insertion_joint"], position=[0.04]))
    assert graph.hearers("stereo/left/image_raw") == 0
    graph.look_at("~/left/compressed")
    scene.until(lambda: graph.hearers("stereo/left/image_raw"))
    camera = load_calibration(CALIBRATION).left
    image = Image(encoding="mono8", width=camera.width, height=camera.height, step=camera.width)
    image.data = array.array("B", bytes(camera.width * camera.height))
    stamp_ns = 0

    def expose() -> bool:
        nonlocal stamp_ns
        stamp_ns += 1_000_000
        image.header.stamp = to_stamp(stamp_ns)
        graph.say("stereo/left/image_raw", image)
        graph.say("needle/tip_pose", graph.pose("rig", 1e-4, stamp_ns))
        for _ in range(5):
            scene.look()
        return bool(graph.heard["~/left/compressed"])

    scene.until(expose)
    seen: CompressedImage = graph.heard["~/left/compressed"][-1]
    assert (seen.format, seen.header.frame_id) == ("jpeg", "left_camera_optical")
    picture = cv2.imdecode(np.frombuffer(seen.data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (camera.height, camera.width, 3)
    u, v = np.round(stereo_views(load_calibration(CALIBRATION))[0].project(np.array(TIP)))
    ring = picture[int(v) - 12 : int(v) + 13, int(u) - 12 : int(u) + 13]
    # Orange: red over green over blue.
    assert (ring[..., 2].astype(int) - ring[..., 0] > 100).sum() > 20
    for subscription in tuple(graph.subscriptions):
        graph.destroy_subscription(subscription)
    scene.until(lambda: graph.hearers("stereo/left/image_raw") == 0)


# ---- the viewers' files

BAG = ROOT / "bags/regression/metadata.yaml"
RVIZ_TYPES = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Path": "nav_msgs/msg/Path",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "Image": "sensor_msgs/msg/CompressedImage",
}
IN_3D = {
    "visualization_msgs/msg/MarkerArray",
    "nav_msgs/msg/Path",
    "geometry_msgs/msg/PoseStamped",
}


def type_name(kind: Any) -> str:
    package, _, _ = kind.__module__.partition(".")
    return f"{package}/msg/{kind.__name__}"


def published() -> dict[str, str]:
    """Return topic to type of all that live_view publishes, and of what a recorded graph did."""
    metadata = yaml.safe_load(BAG.read_text("utf-8"))["rosbag2_bagfile_information"]
    recorded = [one["topic_metadata"] for one in metadata["topics_with_message_count"]]
    ours = {topic.replace("~", "/live_view"): type_name(kind) for topic, kind in OUTPUTS.items()}
    # Every node publishes its health; the committed bag leaves it out.
    health = {"/diagnostics": type_name(DiagnosticArray)}
    return {one["name"]: one["type"] for one in recorded} | ours | health


def test_the_rviz_configuration_shows_what_is_there() -> None:
    document = yaml.safe_load((CONFIG / "live_view.rviz").read_text("utf-8"))
    displays = document["Visualization Manager"]["Displays"]
    shown_topics = {}
    for display in displays:
        name = display["Class"].partition("/")[2]
        if "Topic" in display:
            shown_topics[display["Topic"]["Value"]] = RVIZ_TYPES[name]
        else:
            assert name in ("Grid", "TF")
    there = published()
    assert {topic: there.get(topic) for topic in shown_topics} == shown_topics
    assert set(shown_topics) == {topic.replace("~", "/live_view") for topic in OUTPUTS}
    assert document["Visualization Manager"]["Global Options"]["Fixed Frame"] == "rig"


def test_the_foxglove_layout_shows_what_is_there() -> None:
    layout = json.loads((CONFIG / "live_view.json").read_text("utf-8"))
    there = published()
    shown_topics: set[str] = set()

    def show(topic: str, *kinds: str) -> None:
        assert topic in there
        assert not kinds or there[topic] in kinds
        shown_topics.add(topic)

    for name, panel in layout["configById"].items():
        kind = name.partition("!")[0]
        if kind == "3D":
            for topic in panel["topics"]:
                show(topic, *IN_3D)
        elif kind == "Image":
            show(panel["imageMode"]["imageTopic"], "sensor_msgs/msg/CompressedImage")
        elif kind == "Plot":
            for path in panel["paths"]:
                topic, *fields = path["value"].partition("[")[0].split(".")
                show(topic)
                message = message_class(there[topic])()
                for field in fields:
                    message = getattr(message, field)
        elif kind == "RawMessages":
            show(panel["topicPath"])
        else:
            assert kind == "DiagnosticSummary"
            show(panel["topicToRender"], "diagnostic_msgs/msg/DiagnosticArray")
    assert {topic.replace("~", "/live_view") for topic in OUTPUTS} <= shown_topics

    def panels(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        return [*panels(part["first"]), *panels(part["second"])]

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])


def test_the_help_names_every_topic() -> None:
    for topic in OUTPUTS:
        assert topic in live_view.HELP
