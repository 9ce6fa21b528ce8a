"""pyigtl's client at the real port of openigtlink, in the role of Slicer."""

from __future__ import annotations

import contextlib
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bags.link.link_port import LinkPort
from needle_bags.link.openigtlink import OpenIGTLink, OpenIGTLinkParameters, packed
from needle_bags.live.live_needle import LiveNeedle, MeasuredTip
from needle_core import messages as m
from needle_core.component import Moment, Publish, Send
from needle_core.openigtlink import LinkStream
from needle_core.status_messages import ControllerStatus

LIMIT = 20.0
TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)


class Scene:
    """The component at its real port, and a client outside of ROS, like Slicer."""

    def __init__(self, client: Any) -> None:
        self.component = OpenIGTLink(OpenIGTLinkParameters(port=0))
        self.port = LinkPort("127.0.0.1", 0)
        self.arrived: deque[Any] = deque()
        self.port.open(self.arrived.append)
        self.client = client("127.0.0.1", self.port.port)
        self.proposals: list[Any] = []

    def say(self, topic: str, message: Any) -> None:
        (row,) = (row for row in self.component.inputs if row.topic == topic)
        list(row.handler(message, AT))

    def hears(self, name: str) -> Any:
        """Return the next message with a name."""
        return self.awaits(lambda: self.client.wait_for_message(name, timeout=0))

    def awaits(self, condition: Callable[[], Any]) -> Any:
        """Run component and port until a condition has a value; return it."""
        deadline = time.monotonic() + LIMIT
        while not (found := condition()):
            assert time.monotonic() < deadline
            for action in self.component.timers[0].handler(AT):
                assert isinstance(action, Send)
                self.port.send(action.batch)
            while self.arrived:
                actions = self.component.ports[0].handler(self.arrived.popleft(), AT)
                self.proposals += [a.message for a in actions if isinstance(a, Publish)]
            time.sleep(0.005)
        return found

    def close(self) -> None:
        self.client.stop()
        self.port.close()


def test_pyigtls_client_receives_the_needle_in_mm() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/viewers.md")
    with contextlib.closing(Scene(pyigtl.OpenIGTLinkClient)) as scene:
        assert scene.hears("NeedleStatus").string == "no needle data received"
        status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
        scene.say("needle/controller_status", status)
        x, y, z, w = TURN.as_quat().tolist()
        covariance = tuple(np.diag(np.full(6, 1e-8)).ravel().tolist())
        tip_pose = m.PoseWithCovariance(5_250_000_000, "rig", TIP, (x, y, z, w), covariance)
        scene.say("joint_states", m.JointState(1, ("insertion_joint",), (0.04,)))
        scene.say("needle/tip_pose", tip_pose)
        tip = scene.hears("NeedleTipToRig")
        np.testing.assert_allclose(tip.matrix[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
        np.testing.assert_allclose(tip.matrix[:3, :3], TURN.as_matrix(), atol=1e-6)
        assert tip.timestamp == pytest.approx(5.25)
        (target,) = scene.hears("NeedleTarget").positions
        assert target == pytest.approx((10.0, 0.0, 100.0))


def test_a_target_of_pyigtls_client_is_proposed_in_m() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/viewers.md")
    with contextlib.closing(Scene(pyigtl.OpenIGTLinkClient)) as scene:
        scene.hears("NeedleStatus")
        for version in (1, 2):
            at = [[10.0, -5.0, 90.0 + version], [0.1, 0.0, 0.0]]
            plan = pyigtl.PointMessage(at, ["Target-1", "Entry-1"], device_name="Plan")
            plan.header_version, plan.metadata = version, {"unit": "mm"} if version == 2 else {}
            scene.client.send_message(plan, wait=False)
            (point,) = scene.awaits(lambda: scene.proposals)
            scene.proposals.clear()
            assert point.position == pytest.approx((0.01, -0.005, 0.09 + version * 1e-3))


def test_the_shape_is_a_polydata_line_in_mm() -> None:
    pytest.importorskip("pyigtl", reason="the lock is not installed: docs/viewers.md")
    needle = LiveNeedle()
    needle.set_insertion(0.04)
    needle.add_tip(MeasuredTip(1, np.array(TIP), TURN.as_quat(), np.eye(3)))
    (message,) = (one for one in LinkStream().split(packed(needle, 1.0)) if one.kind == "POLYDATA")
    # As in http://openigtlink.org/protocols/v2_polydata.html.
    counts, data = struct.unpack(">10I", message.body[:40]), message.body[40:]
    assert counts == (2, 0, 0, 1, 12, 0, 0, 0, 0, 0)
    points = np.frombuffer(data[:24], ">f4").reshape(2, 3)
    np.testing.assert_allclose(points, np.array([(0.0, 0.0, 0.0), TIP]) * 1e3, rtol=1e-6)
    assert struct.unpack(">3I", data[24:]) == (2, 0, 1)
