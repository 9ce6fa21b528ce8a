"""The files by which viewers show what live_view sends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import yaml

from needle_bags.format.message_definitions import message_class
from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_bags.ros import live_view as executable
from needle_core import messages as m
from needle_core.convert import ros_type

ROOT = Path(__file__).parents[5]
CONFIG = ROOT / "ros2_ws/src/needle_bags/config"
VIEW = LiveView(LiveViewParameters(), transforms=False)
OUTPUTS = {f"/{row.topic}": ros_type(row.message) for row in VIEW.outputs}
PICTURE = "sensor_msgs/msg/CompressedImage"
RVIZ = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Path": "nav_msgs/msg/Path",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "Image": PICTURE,
}


def published() -> dict[str, str]:
    """Return topic to type of all that live_view publishes, and of what a recorded graph did."""
    metadata = yaml.safe_load((ROOT / "bags/regression/metadata.yaml").read_text("utf-8"))
    topics = metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    recorded = [one["topic_metadata"] for one in topics]
    # Every node publishes its health; the committed bag leaves it out.
    health = {"/diagnostics": ros_type(m.Diagnostics)}
    return {one["name"]: one["type"] for one in recorded} | OUTPUTS | health


def test_the_rviz_configuration_and_the_help_have_the_published_topics() -> None:
    document = yaml.safe_load((CONFIG / "live_view.rviz").read_text("utf-8"))
    manager, there = document["Visualization Manager"], published()
    kinds = {one["Class"].partition("/")[2]: one for one in manager["Displays"]}
    assert {name for name, one in kinds.items() if "Topic" not in one} == {"Grid", "TF"}
    shown = {
        display["Topic"]["Value"]: RVIZ[display["Class"].partition("/")[2]]
        for display in manager["Displays"]
        if "Topic" in display
    }
    assert {topic: there.get(topic) for topic in shown} == shown
    assert shown.keys() == OUTPUTS.keys()
    assert manager["Global Options"]["Fixed Frame"] == "rig"
    assert all(topic.replace("/live_view", "~") in executable.HELP for topic in OUTPUTS)


def test_the_foxglove_layout_has_the_published_topics() -> None:
    layout = json.loads((CONFIG / "live_view.json").read_text("utf-8"))
    there = published()
    shown: set[str] = set()
    for name, panel in layout["configById"].items():
        match name.partition("!")[0]:
            case "3D":
                wanted = {topic: set(RVIZ.values()) - {PICTURE} for topic in panel["topics"]}
            case "Image":
                wanted = {panel["imageMode"]["imageTopic"]: {PICTURE}}
            case "Plot":
                ways = [path["value"].partition("[")[0].split(".") for path in panel["paths"]]
                wanted = {topic: {there[topic]} for topic, *_ in ways}
                for topic, *fields in ways:
                    message = message_class(there[topic])()
                    for field in fields:
                        message = getattr(message, field)
            case "RawMessages":
                wanted = {panel["topicPath"]: {there[panel["topicPath"]]}}
            case kind:
                assert kind == "DiagnosticSummary"
                wanted = {panel["topicToRender"]: {"diagnostic_msgs/msg/DiagnosticArray"}}
        assert all(there[topic] in kinds for topic, kinds in wanted.items())
        shown |= wanted.keys()
    assert OUTPUTS.keys() <= shown

    def panels(part: Any) -> list[str]:
        return [part] if isinstance(part, str) else panels(part["first"]) + panels(part["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
