"""What pyigtl's own client hears of a graph that the test plays."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState

from needle_analysis.ros import openigtlink
from needle_analysis.ros.openigtlink import OpenIGTLinkNode
from needle_core.ros.base_node import executor_of
from needle_core.ros.conversions import JOINT_STATES, LATCHED, RELIABLE, to_stamp
from own_context import own_context

pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/slicer.md")

LIMIT = 20.0
TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))


class Scene:
    """A graph that is played, the node, and a client as Slicer is one."""

    def __init__(self, context: Context) -> None:
        overrides = [Parameter("port", value=0), Parameter("rate", value=30.0)]
        self.node = OpenIGTLinkNode(context, overrides)
        self.graph = Node("played_graph", context=context)
        self._executors = (SingleThreadedExecutor(context=context), executor_of(self.node))
        self._executors[0].add_node(self.graph)
        self._send = {
            topic: self.graph.create_publisher(kind, topic, qos)
            for topic, kind, qos in (
                ("joint_states", JointState, JOINT_STATES),
                ("needle/tip_pose", PoseWithCovarianceStamped, RELIABLE),
                ("needle/estimate", PoseWithCovarianceStamped, RELIABLE),
                ("needle/controller_status", DiagnosticStatus, LATCHED),
            )
        }
        self.until(lambda: all(one.get_subscription_count() for one in self._send.values()))
        self.client = pyigtl.OpenIGTLinkClient("127.0.0.1", self.node.server.port)

    def say(self, topic: str, message: Any) -> None:
        self._send[topic].publish(message)

    def pose(self, topic: str, stamp_ns: int, sigma: float = 1e-4) -> None:
        message = PoseWithCovarianceStamped()
        message.header.stamp = to_stamp(stamp_ns)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        p.x, p.y, p.z = TIP
        q.x, q.y, q.z, q.w = TURN.as_quat().tolist()
        message.pose.covariance = np.diag(np.full(6, sigma**2)).ravel()
        self.say(topic, message)

    def until(self, condition: Callable[[], Any]) -> Any:
        deadline = time.monotonic() + LIMIT
        while not (found := condition()):
            assert time.monotonic() < deadline
            for executor in self._executors:
                executor.spin_once(timeout_sec=0.005)
        return found

    def hears(self, name: str, which: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the next message of a name of which a condition holds."""

        def heard() -> Any:
            message = self.client.wait_for_message(name, timeout=0)
            return message if message is not None and which(message) else None

        return self.until(heard)

    def close(self) -> None:
        self.client.stop()
        for executor in self._executors:
            executor.shutdown()
        self.node.destroy_node()
        self.graph.destroy_node()


@pytest.fixture
def scene() -> Iterator[Scene]:
    with own_context() as context, contextlib.closing(Scene(context)) as one:
        yield one


def test_slicer_hears_the_needle_in_mm(scene: Scene) -> None:
    assert scene.hears("NeedleStatus").string == "nothing heard of the needle"
    values = {"target_offset_m": "0.003", "target_point_m": "0.01, 0.0, 0.1"}
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    scene.say("needle/controller_status", DiagnosticStatus(values=pairs))
    plane = scene.hears("TargetPlaneToRig").matrix
    np.testing.assert_allclose(plane[:3, 3], [3.0, 0.0, 0.0])
    (target,) = scene.hears("NeedleTarget").positions
    assert target == pytest.approx((10.0, 0.0, 100.0))
    scene.say("joint_states", JointState(name=["insertion_joint"], position=[0.04]))
    scene.pose("needle/tip_pose", 5_250_000_000)
    tip = scene.hears("NeedleTipToRig")
    np.testing.assert_allclose(tip.matrix[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
    np.testing.assert_allclose(tip.matrix[:3, :3], TURN.as_matrix(), atol=1e-6)
    assert tip.timestamp == pytest.approx(5.25)
    shaft = scene.hears("NeedleShaft").positions
    assert shaft[0] == (0.0, 0.0, 0.0)
    assert shaft[-1] == pytest.approx(np.array(TIP) * 1e3)
    # In the frame of the plane, 3 mm beside.
    scene.pose("needle/estimate", 5_250_000_000)
    estimate = scene.hears("NeedleEstimateToRig").matrix
    np.testing.assert_allclose(estimate[:3, 3], [4.0, 2.0, 40.0], rtol=1e-6)


def test_a_tip_that_is_not_seen_is_not_shown(scene: Scene) -> None:
    scene.pose("needle/tip_pose", 1_000_000_000)
    scene.hears("NeedleTipToRig")
    scene.pose("needle/tip_pose", 2_000_000_000, sigma=np.inf)
    scene.hears("NeedleStatus", lambda status: status.string == "no tip found")
    scene.client.get_latest_messages()
    scene.hears("NeedleStatus")
    scene.hears("NeedleStatus")
    assert scene.client.wait_for_message("NeedleTipToRig", timeout=0) is None
    assert scene.client.wait_for_message("NeedleShaft", timeout=0) is None


def test_garbage_at_the_port_leaves_node_and_listener_as_they_are(scene: Scene) -> None:
    scene.hears("NeedleStatus")
    with socket.create_connection(("127.0.0.1", scene.node.server.port)) as stranger:
        stranger.sendall(bytes(range(256)) * 100)
        scene.until(lambda: scene.node.server.listeners == 2)
        # A target that it would like to set.
        stranger.sendall(pyigtl.PointMessage([1.0, 2.0, 3.0], device_name="NeedleTarget").pack())
        scene.hears("NeedleStatus")
    scene.until(lambda: scene.node.server.listeners == 1)
    scene.hears("NeedleStatus")
    assert scene.client.wait_for_message("NeedleTarget", timeout=0) is None


def test_without_pyigtl_it_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert openigtlink.main() == 2
    assert "pyigtl is not installed; docs/slicer.md" in capsys.readouterr().err
