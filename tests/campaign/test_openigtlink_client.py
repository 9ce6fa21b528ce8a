"""What pyigtl's own client hears at the real port of openigtlink, as Slicer would."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bags.link.link_port import LinkPort
from needle_bags.link.openigtlink import OpenIGTLink, OpenIGTLinkParameters
from needle_core import messages as m
from needle_core.component import Moment, Send
from needle_core.status_messages import ControllerStatus

LIMIT = 20.0
TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)


class Scene:
    """The component at its real port, and a client as Slicer is one: neither ROS nor virtual."""

    def __init__(self, client: Any) -> None:
        self.component = OpenIGTLink(OpenIGTLinkParameters(port=0))
        self.port = LinkPort(self.component.settings)
        self.arrived: deque[Any] = deque()
        self.port.open(self.arrived.append)
        self.client = client("127.0.0.1", self.port.server.port)

    def say(self, topic: str, message: Any) -> None:
        (row,) = (row for row in self.component.inputs if row.topic == topic)
        list(row.handler(message, AT))

    def hears(self, name: str) -> Any:
        """Return the next message of a name; what the port tells reaches the component."""
        deadline = time.monotonic() + LIMIT
        while (message := self.client.wait_for_message(name, timeout=0)) is None:
            assert time.monotonic() < deadline
            for action in self.component.timers[0].handler(AT):
                assert isinstance(action, Send)
                self.port.send(action.batch)
            while self.arrived:
                list(self.component.ports[0].handler(self.arrived.popleft(), AT))
            time.sleep(0.005)
        return message

    def close(self) -> None:
        self.client.stop()
        self.port.close()


def test_pyigtls_client_hears_the_needle_in_mm() -> None:
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
        shaft = scene.hears("NeedleShaft").positions
        assert shaft[-1] == pytest.approx(np.array(TIP) * 1e3)
