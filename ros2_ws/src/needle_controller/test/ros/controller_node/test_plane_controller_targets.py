"""Planes, points and obstacles that are given to the node while it runs."""

from __future__ import annotations

from geometry_msgs.msg import (
    PointStamped,
    PoseStamped,
)
from visualization_msgs.msg import Marker, MarkerArray

from needle_core.diagnostics import Level
from needle_core.ros.conversions import (
    RELIABLE,
)

from .node_bench import Bench


def test_a_plane_given_at_run_time_and_planes_refused(bench: Bench) -> None:
    message = PoseStamped()
    message.header.frame_id = "rig"
    message.pose.position.x = 0.005
    message.pose.orientation.w = 1.0
    bench._planes.publish(message)
    bench.until(lambda: bench.status["target_offset_m"] == "0.005")
    message.pose.position.x = float("nan")
    bench._planes.publish(message)
    bench.until(lambda: bench.health("target_plane")[0] == Level.WARN)
    assert "not finite" in bench.health("target_plane")[1]
    assert bench.status["target_offset_m"] == "0.005"


def test_a_point_given_at_run_time_until_a_plane_is(bench: Bench) -> None:
    message = PointStamped()
    message.header.frame_id = "rig"
    message.point.x, message.point.z = 0.01, 0.1
    bench._points.publish(message)
    bench.until(lambda: bench.status["target_point_m"] == "0.01, 0.0, 0.1")
    message.point.x = 0.09
    bench._points.publish(message)
    bench.until(lambda: bench.health("target_point")[0] == Level.WARN)
    assert "entering at" in bench.health("target_point")[1]
    assert bench.status["target_point_m"] == "0.01, 0.0, 0.1"
    plane = PoseStamped()
    plane.header.frame_id = "rig"
    plane.pose.orientation.w = 1.0
    bench._planes.publish(plane)
    bench.until(lambda: not bench.status["target_point_m"])


def at_offset(bench: Bench, offset: float) -> bool:
    return bench.status["target_offset_m"] == str(offset)


def test_obstacles_given_at_run_time_and_obstacles_refused(bench: Bench) -> None:
    assert bench.status["obstacles"] == "0"
    made = Marker(type=Marker.SPHERE)
    made.header.frame_id = "rig"
    made.scale.x = made.scale.y = made.scale.z = 0.004
    made.pose.position.z = 0.06
    bench.obstacles.publish(MarkerArray(markers=[made]))
    bench.until(lambda: bench.status["obstacles"] == "1")
    bad = Marker(type=Marker.CUBE, header=made.header)
    bench.obstacles.publish(MarkerArray(markers=[bad]))
    bench.until(lambda: bench.health("obstacles")[0] == Level.WARN)
    assert "the last obstacles stay" in bench.health("obstacles")[1]
    assert bench.status["obstacles"] == "1"
    bench.obstacles.publish(MarkerArray())
    bench.until(lambda: bench.status["obstacles"] == "0")


def test_a_plain_publisher_of_planes_is_named_with_the_cure(bench: Bench) -> None:
    plain = bench.outside.create_publisher(PoseStamped, "target_plane", RELIABLE)
    bench.until(lambda: bench.health("input")[0] == Level.WARN)
    assert bench.health("input")[1] == "target_plane: refused: incompatible QoS"
    values = bench.health_values("input")
    assert "--qos-durability transient_local" in values["last"]
    bench.outside.destroy_publisher(plain)
