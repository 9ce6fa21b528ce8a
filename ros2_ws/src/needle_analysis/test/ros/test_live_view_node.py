"""live_view on a real graph, and the viewers' files that show it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image
from visualization_msgs.msg import MarkerArray

from needle_analysis.live.live_view import LiveView, LiveViewParameters
from needle_analysis.ros import live_view as executable
from needle_bags.format.message_definitions import message_class
from needle_core import messages as m
from needle_core.convert import ros_type
from needle_core.ros.component_node import ComponentNode
from needle_core.ros.conversions import IMAGES, RELIABLE, to_stamp
from own_context import own_context

ROOT = Path(__file__).parents[5]
CONFIG = ROOT / "ros2_ws/src/needle_analysis/config"
LIMIT = 20.0


def make(settings: LiveViewParameters, _: str = "") -> LiveView:
    return LiveView(settings, transforms=False)


OUTPUTS = {f"/{row.topic}": ros_type(row.message) for row in make(LiveViewParameters()).outputs}


def test_a_viewer_of_a_replay_finds_its_topics_stamped_by_the_players_clock() -> None:
    with own_context() as context:
        view = ComponentNode(
            "live_view",
            LiveViewParameters,
            make,
            context=context,
            parameter_overrides=[Parameter("use_sim_time", value=True)],
        )
        viewer = Node("viewer", context=context)
        clock = viewer.create_publisher(Clock, "/clock", RELIABLE)
        images = viewer.create_publisher(Image, "stereo/left/image_raw", IMAGES)
        seconds: list[int] = []
        viewer.create_subscription(
            MarkerArray,
            "/live_view/markers",
            lambda message: seconds.append(message.markers[0].header.stamp.sec),
            RELIABLE,
        )
        looks = viewer.create_subscription(
            CompressedImage, "/live_view/left/compressed", lambda _: None, RELIABLE
        )
        executor = SingleThreadedExecutor(context=context)
        for node in (view, viewer):
            executor.add_node(node)

        def until(condition: Callable[[], object]) -> None:
            deadline = time.monotonic() + LIMIT
            while not condition():
                assert time.monotonic() < deadline
                clock.publish(Clock(clock=to_stamp(42_500_000_000)))
                executor.spin_once(timeout_sec=0.02)

        until(lambda: seconds[-1:] == [42])
        until(lambda: images.get_subscription_count() == 1)
        viewer.destroy_subscription(looks)
        until(lambda: images.get_subscription_count() == 0)
        executor.shutdown()
        for node in (view, viewer):
            node.destroy_node()


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


def published() -> dict[str, str]:
    """Return topic to type of all that live_view publishes, and of what a recorded graph did."""
    metadata = yaml.safe_load(BAG.read_text("utf-8"))["rosbag2_bagfile_information"]
    recorded = [one["topic_metadata"] for one in metadata["topics_with_message_count"]]
    # Every node publishes its health; the committed bag leaves it out.
    health = {"/diagnostics": ros_type(m.Diagnostics)}
    return {one["name"]: one["type"] for one in recorded} | OUTPUTS | health


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
    assert set(shown_topics) == set(OUTPUTS)
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
    assert set(OUTPUTS) <= shown_topics

    def panels(part: Any) -> list[str]:
        if isinstance(part, str):
            return [part]
        return [*panels(part["first"]), *panels(part["second"])]

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])


def test_the_help_names_every_topic() -> None:
    for topic in OUTPUTS:
        assert topic.replace("/live_view", "~") in executable.HELP
