"""Configuration files of viewers for the topics of live_view."""

from __future__ import annotations

import json
from pathlib import Path

import yaml

from needle_bags.format.message_definitions import message_class
from needle_bags.live.live_view import LiveView, LiveViewParameters
from needle_bags.ros import live_view as executable
from needle_core import messages as m
from needle_core.convert import ros_type

ROOT = Path(__file__).parents[5]
CONFIG = ROOT / "ros2_ws/src/needle_bags/config"
VIEW = LiveView(LiveViewParameters(foxglove_port=1), transforms=False)
OUTPUTS = {f"/{row.topic}": ros_type(row.message) for row in VIEW.outputs}
CHANNELS = {f"/{row.topic.lstrip('/')}": ros_type(row.message) for row in VIEW.channels}
PICTURE = "sensor_msgs/msg/CompressedImage"
RVIZ = {
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Path": "nav_msgs/msg/Path",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "Image": PICTURE,
    "RobotModel": "std_msgs/msg/String",
}


def published() -> dict[str, str]:
    """Return the type of each topic that live_view or a recorded graph publishes."""
    metadata = yaml.safe_load((ROOT / "bags/regression/metadata.yaml").read_text("utf-8"))
    topics = metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    recorded = [one["topic_metadata"] for one in topics]
    # Every node publishes its health; the committed bag leaves it out.
    health = {"/diagnostics": ros_type(m.Diagnostics)}
    obstacles = {"/obstacles": ros_type(m.Markers)}
    return {one["name"]: one["type"] for one in recorded} | OUTPUTS | health | obstacles


def test_the_rviz_configuration_and_the_help_have_the_published_topics() -> None:
    document = yaml.safe_load((CONFIG / "live_view.rviz").read_text("utf-8"))
    manager, there = document["Visualization Manager"], published()
    displays = [(one["Class"].partition("/")[2], one) for one in manager["Displays"]]
    topics = [(kind, one.get("Topic", one.get("Description Topic"))) for kind, one in displays]
    assert {kind for kind, topic in topics if topic is None} == {"Grid", "TF"}
    shown = {topic["Value"]: RVIZ[kind] for kind, topic in topics if topic is not None}
    assert {topic: there.get(topic) for topic in shown} == shown
    assert shown.keys() == OUTPUTS.keys()
    assert manager["Global Options"]["Fixed Frame"] == "rig"
    names = (topic.replace("/live_view", "~").replace("/robot", "robot") for topic in OUTPUTS)
    assert all(name in executable.HELP for name in names)


def test_the_foxglove_layout_has_the_published_topics() -> None:
    layout = json.loads((CONFIG / "live_view.json").read_text("utf-8"))
    there = published()
    shown: set[str] = set()
    for name, panel in layout["configById"].items():
        match name.partition("!")[0]:
            case "3D":
                shown |= panel["topics"].keys()
            case "Image":
                shown.add(panel["imageMode"]["imageTopic"])
            case "Plot":
                for path in panel["paths"]:
                    topic, *fields = path["value"].partition("[")[0].split(".")
                    message = message_class(there[topic])()
                    for field in fields:
                        message = getattr(message, field)
                    shown.add(topic)
            case "RawMessages":
                shown.add(panel["topicPath"])
            case kind:
                assert kind == "DiagnosticSummary"
                shown.add(panel["topicToRender"])
    assert OUTPUTS.keys() <= shown <= there.keys()
    # Foxglove shows all of it over the port as well.
    assert {topic: there[topic] for topic in shown} == {topic: CHANNELS[topic] for topic in shown}
