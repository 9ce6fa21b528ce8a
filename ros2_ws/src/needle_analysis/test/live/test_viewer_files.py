"""The files by which viewers show what live_view sends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from needle_analysis.live.live_view import LiveView, LiveViewParameters
from needle_analysis.ros import live_view as executable
from needle_bags.format.message_definitions import message_class
from needle_core import messages as m
from needle_core.convert import ros_type

ROOT = Path(__file__).parents[5]
CONFIG = ROOT / "ros2_ws/src/needle_analysis/config"
VIEW = LiveView(LiveViewParameters(), transforms=False)
OUTPUTS = {f"/{row.topic}": ros_type(row.message) for row in VIEW.outputs}
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
