"""pyigtl's client at the real port of openigtlink, in the role of Slicer."""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bags.link.link_port import LinkPort
from needle_bags.link.openigtlink import OpenIGTLink, OpenIGTLinkParameters, packed
from needle_bags.live.live_needle import LiveNeedle, MeasuredTip
from needle_core.component import Moment, Publish, Send
from needle_core.openigtlink import LinkStream

pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/viewers.md")
LIMIT = 20.0
TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)


@pytest.fixture
def needle() -> LiveNeedle:
    needle = LiveNeedle()
    needle.set_insertion(0.04)
    needle.set_targets(0.003, np.array((0.01, 0.0, 0.1)))
    needle.add_tip(MeasuredTip(5_250_000_000, np.array(TIP), TURN.as_quat(), np.eye(3)))
    return needle


class Scene:
    """The component at its real port, and a client outside of ROS, like Slicer."""

    def __init__(self) -> None:
        self.component = OpenIGTLink(OpenIGTLinkParameters(port=0))
        self.port = LinkPort("127.0.0.1", 0)
        self.arrived: deque[Any] = deque()
        self.port.open(self.arrived.append)
        self.client = pyigtl.OpenIGTLinkClient("127.0.0.1", self.port.port)
        self.proposals: list[Any] = []

    def wait_for(self, condition: Callable[[], Any]) -> Any:
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


@pytest.fixture
def scene(needle: LiveNeedle) -> Iterator[Scene]:
    scene = Scene()
    scene.component._needle = needle
    yield scene
    scene.client.stop()
    scene.port.close()


def test_pyigtls_client_receives_the_needle_in_mm(scene: Scene) -> None:
    def receive(name: str) -> Any:
        return scene.wait_for(lambda: scene.client.wait_for_message(name, timeout=0))

    assert receive("NeedleStatus").string == "tip found"
    tip = receive("NeedleTipToRig")
    np.testing.assert_allclose(tip.matrix[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
    np.testing.assert_allclose(tip.matrix[:3, :3], TURN.as_matrix(), atol=1e-6)
    assert tip.timestamp == pytest.approx(5.25)
    (target,) = receive("NeedleTarget").positions
    assert target == pytest.approx((10.0, 0.0, 100.0))


def test_a_target_of_pyigtls_client_is_proposed_in_m(scene: Scene) -> None:
    for version in (1, 2):
        at = [[10.0, -5.0, 90.0 + version], [0.1, 0.0, 0.0]]
        plan = pyigtl.PointMessage(at, ["Target-1", "Entry-1"], device_name="Plan")
        plan.header_version, plan.metadata = version, {"unit": "mm"} if version == 2 else {}
        scene.wait_for(scene.client.is_connected)
        scene.client.send_message(plan, wait=False)
        (point,) = scene.wait_for(lambda: scene.proposals)
        scene.proposals.clear()
        assert point.position == pytest.approx((0.01, -0.005, 0.09 + version * 1e-3))


def test_the_shape_is_a_polydata_line_in_mm(needle: LiveNeedle) -> None:
    (message,) = (one for one in LinkStream().split(packed(needle, 1.0)) if one.kind == "POLYDATA")
    # As in http://openigtlink.org/protocols/v2_polydata.html.
    counts, data = struct.unpack(">10I", message.body[:40]), message.body[40:]
    assert counts == (2, 0, 0, 1, 12, 0, 0, 0, 0, 0)
    points = np.frombuffer(data[:24], ">f4").reshape(2, 3)
    np.testing.assert_allclose(points, np.array([(0.0, 0.0, 0.0), TIP]) * 1e3, rtol=1e-6)
    assert struct.unpack(">3I", data[24:]) == (2, 0, 1)
