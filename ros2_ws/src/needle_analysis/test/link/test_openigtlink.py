"""openigtlink: what pyigtl's own client hears at the real port, and what the port tells."""

from __future__ import annotations

import contextlib
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_analysis.link.link_port import LinkPort
from needle_analysis.link.openigtlink import (
    LINK,
    Listeners,
    OpenIGTLink,
    OpenIGTLinkParameters,
)
from needle_core import messages as m
from needle_core.component import Diagnose, Log, Moment, Send
from needle_core.diagnostics import Diagnostic, Level
from needle_core.status_messages import ControllerStatus

LIMIT = 20.0
TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)


def test_nothing_is_packed_while_nobody_listens() -> None:
    component = OpenIGTLink(OpenIGTLinkParameters())
    (timer,), (port,) = component.timers, component.ports
    assert list(timer.handler(AT)) == [Send(LINK, (b"",))]
    keys = {"listeners": "0", "turned away": "2"}
    told = Diagnose("listeners", Diagnostic(Level.OK, "nobody listens", keys))
    assert list(port.handler((Listeners(0, 2),), AT)) == [told]


class Scene:
    """The component at its real port, and a client as Slicer is one: neither ROS nor virtual."""

    def __init__(self, client: Any) -> None:
        self.component = OpenIGTLink(OpenIGTLinkParameters(port=0))
        self.port = LinkPort(self.component.settings)
        self.arrived: deque[Any] = deque()
        self.port.open(self.arrived.append)
        self.told: list[Any] = []
        self.client = client("127.0.0.1", self.port.server.port)

    def say(self, topic: str, message: Any) -> None:
        (row,) = (row for row in self.component.inputs if row.topic == topic)
        list(row.handler(message, AT))

    def turn(self) -> None:
        """Do what a timer does, and take what the port has told."""
        for action in self.component.timers[0].handler(AT):
            assert isinstance(action, Send)
            self.port.send(action.batch)
        while self.arrived:
            self.told += self.component.ports[0].handler(self.arrived.popleft(), AT)

    def until(self, condition: Callable[[], Any]) -> Any:
        deadline = time.monotonic() + LIMIT
        while not (found := condition()):
            assert time.monotonic() < deadline
            self.turn()
            time.sleep(0.005)
        return found

    def hears(self, name: str, which: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the next message of a name of which a condition holds."""

        def heard() -> Any:
            message = self.client.wait_for_message(name, timeout=0)
            return message if message is not None and which(message) else None

        return self.until(heard)

    def listeners(self) -> str:
        return str(self.told[-1].diagnostic.values["listeners"])

    def close(self) -> None:
        self.client.stop()
        self.port.close()


def pose(stamp_ns: int, sigma: float = 1e-4) -> m.PoseWithCovariance:
    x, y, z, w = TURN.as_quat().tolist()
    covariance = tuple(np.diag(np.full(6, sigma**2)).ravel().tolist())
    return m.PoseWithCovariance(stamp_ns, "rig", TIP, (x, y, z, w), covariance)


@pytest.fixture
def scene() -> Iterator[Scene]:
    pyigtl = pytest.importorskip("pyigtl", reason="the lock is not installed: docs/slicer.md")
    with contextlib.closing(Scene(pyigtl.OpenIGTLinkClient)) as one:
        yield one


def test_slicer_hears_the_needle_in_mm(scene: Scene) -> None:
    assert scene.hears("NeedleStatus").string == "nothing heard of the needle"
    status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
    scene.say("needle/controller_status", status)
    plane = scene.hears("TargetPlaneToRig")
    np.testing.assert_allclose(plane.matrix[:3, 3], [3.0, 0.0, 0.0])
    assert plane.timestamp == pytest.approx(7.0)
    (target,) = scene.hears("NeedleTarget").positions
    assert target == pytest.approx((10.0, 0.0, 100.0))
    scene.say("joint_states", m.JointState(1, ("insertion_joint",), (0.04,)))
    scene.say("needle/tip_pose", pose(5_250_000_000))
    tip = scene.hears("NeedleTipToRig")
    np.testing.assert_allclose(tip.matrix[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
    np.testing.assert_allclose(tip.matrix[:3, :3], TURN.as_matrix(), atol=1e-6)
    assert tip.timestamp == pytest.approx(5.25)
    shaft = scene.hears("NeedleShaft").positions
    assert shaft[0] == (0.0, 0.0, 0.0)
    assert shaft[-1] == pytest.approx(np.array(TIP) * 1e3)
    # In the frame of the plane, 3 mm beside.
    scene.say("needle/estimate", pose(5_250_000_000))
    estimate = scene.hears("NeedleEstimateToRig").matrix
    np.testing.assert_allclose(estimate[:3, 3], [4.0, 2.0, 40.0], rtol=1e-6)


@pytest.mark.parametrize(
    "unseen",
    [pose(2_000_000_000, np.inf), m.PoseWithCovariance(2, "rig", TIP, (0.0,) * 4, (0.0,) * 36)],
)
def test_a_tip_that_is_not_seen_is_not_shown(scene: Scene, unseen: m.PoseWithCovariance) -> None:
    scene.say("needle/tip_pose", pose(1_000_000_000))
    scene.hears("NeedleTipToRig")
    scene.say("needle/tip_pose", unseen)
    scene.hears("NeedleStatus", lambda status: status.string == "no tip found")
    scene.client.get_latest_messages()
    scene.hears("NeedleStatus")
    scene.hears("NeedleStatus")
    assert scene.client.wait_for_message("NeedleTipToRig", timeout=0) is None
    assert scene.client.wait_for_message("NeedleShaft", timeout=0) is None


def test_the_port_tells_where_it_is_and_who_listens(scene: Scene) -> None:
    scene.hears("NeedleStatus")
    where = f"shows the needle at 127.0.0.1, port {scene.port.server.port}"
    assert scene.told[0] == Log("info", where)
    assert scene.listeners() == "1"
    scene.client.stop()
    scene.until(lambda: scene.listeners() == "0")


def test_garbage_at_the_port_leaves_component_and_listener_as_they_are(scene: Scene) -> None:
    pyigtl = pytest.importorskip("pyigtl")
    scene.hears("NeedleStatus")
    with socket.create_connection(("127.0.0.1", scene.port.server.port)) as stranger:
        stranger.sendall(bytes(range(256)) * 100)
        scene.until(lambda: scene.listeners() == "2")
        # A target that it would like to set.
        stranger.sendall(pyigtl.PointMessage([1.0, 2.0, 3.0], device_name="NeedleTarget").pack())
        scene.hears("NeedleStatus")
    scene.until(lambda: scene.listeners() == "1")
    scene.hears("NeedleStatus")
    assert scene.client.wait_for_message("NeedleTarget", timeout=0) is None
