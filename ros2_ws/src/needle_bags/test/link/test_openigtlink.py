"""openigtlink with a simulated pyigtl (an extra): packed messages and proposed targets."""

from __future__ import annotations

import contextlib
import json
import struct
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_bags.link.link_port import LinkPort
from needle_bags.link.openigtlink import (
    LINK,
    Listeners,
    OpenIGTLink,
    OpenIGTLinkParameters,
)
from needle_bags.ros import openigtlink as executable
from needle_core import messages as m
from needle_core.component import Diagnose, Log, Moment, Publish, Send
from needle_core.diagnostics import Level
from needle_core.openigtlink import LinkMessage, LinkStream
from needle_core.status_messages import ControllerStatus
from plus_messages import message as link_message

TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)
Packed = dict[str, tuple[Any, float]]


class Played:
    """Stand-in for a pyigtl message: content, time and device name; for points also their names."""

    def __init__(self, *given: Any, **named: Any) -> None:
        # A POLYDATA has the points first, then the lines.
        content, *_, time, name = (*given, *named.values())
        self._content = [name, np.asarray(content).tolist(), time]

    def pack(self) -> bytes:
        return json.dumps(self._content).encode() + b"\n"


@pytest.fixture
def component(monkeypatch: pytest.MonkeyPatch) -> OpenIGTLink:
    """The component with a connected client."""
    names = ("StringMessage", "TransformMessage", "PointMessage", "PolyDataMessage")
    kinds = dict.fromkeys(names, Played)
    played: Any = SimpleNamespace(**kinds)
    monkeypatch.setitem(sys.modules, "pyigtl", SimpleNamespace(messages=played))
    monkeypatch.setitem(sys.modules, "pyigtl.messages", played)
    one = OpenIGTLink(OpenIGTLinkParameters(port=0))
    list(one.ports[0].handler((Listeners(1),), AT))
    return one


def packed(component: OpenIGTLink) -> Packed:
    (action,) = component.timers[0].handler(AT)
    assert isinstance(action, Send)
    assert action.port == LINK
    lines = b"".join(action.batch).decode().splitlines()
    return {name: (content, time) for name, content, time in map(json.loads, lines)}


def receive(component: OpenIGTLink, topic: str, message: Any) -> None:
    (row,) = (row for row in component.inputs if row.topic == topic)
    list(row.handler(message, AT))


def pose(stamp_ns: int, sigma: float = 1e-4) -> m.PoseWithCovariance:
    x, y, z, w = TURN.as_quat().tolist()
    covariance = tuple(np.diag(np.full(6, sigma**2)).ravel().tolist())
    return m.PoseWithCovariance(stamp_ns, "rig", TIP, (x, y, z, w), covariance)


def test_messages_are_in_mm(component: OpenIGTLink) -> None:
    assert packed(component) == {"NeedleStatus": ("no needle data received", 7.0)}
    status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
    receive(component, "needle/controller_status", status)
    receive(component, "joint_states", m.JointState(1, ("insertion_joint",), (0.04,)))
    receive(component, "needle/tip_pose", pose(5_250_000_000))
    # In the frame of the plane, offset by 3 mm.
    receive(component, "needle/estimate", pose(5_250_000_000))
    messages = packed(component)
    assert messages["NeedleStatus"][0] == "tip found"
    plane, time = messages["TargetPlaneToRig"]
    np.testing.assert_allclose(np.array(plane)[:3, 3], [3.0, 0.0, 0.0])
    assert time == pytest.approx(7.0)
    (target,) = messages["NeedleTarget"][0]
    assert target == pytest.approx([10.0, 0.0, 100.0])
    tip, time = messages["NeedleTipToRig"]
    np.testing.assert_allclose(np.array(tip)[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
    np.testing.assert_allclose(np.array(tip)[:3, :3], TURN.as_matrix(), atol=1e-6)
    assert time == pytest.approx(5.25)
    shaft = messages["NeedleShaft"][0]
    assert (shaft[0], shaft[-1]) == ([0.0] * 3, pytest.approx(np.array(TIP) * 1e3))
    estimate = np.array(messages["NeedleEstimateToRig"][0])
    np.testing.assert_allclose(estimate[:3, 3], [4.0, 2.0, 40.0], rtol=1e-6)
    # The shape follows the estimates.
    shape, time = messages["NeedleShape"]
    assert (shape[0], shape[-1]) == ([0.0] * 3, pytest.approx([4.0, 2.0, 40.0]))
    assert time == pytest.approx(5.25)
    # A plan belongs to one estimate.
    receive(component, "needle/planned_path", m.Path(4, "rig", ((0.0, 0.0, 0.1),)))
    assert "NeedlePlan" not in packed(component)
    path = m.Path(5_250_000_000, "rig", ((0.01, 0.0, 0.08), (0.01, 0.0, 0.1)))
    receive(component, "needle/planned_path", path)
    plan = np.array(packed(component)["NeedlePlan"][0])
    np.testing.assert_allclose(plan, [[10.0, 0.0, 80.0], [10.0, 0.0, 100.0]])
    # A lost tip is not shown.
    for unseen in (
        pose(2_000_000_000, np.inf),
        m.PoseWithCovariance(2, "rig", TIP, (0.0,) * 4, (0.0,) * 36),
    ):
        receive(component, "needle/tip_pose", unseen)
        messages = packed(component)
        assert messages["NeedleStatus"][0] == "no tip found"
        assert not messages.keys() & {"NeedleTipToRig", "NeedleShaft"}


def test_the_port_reports_clients_and_without_any_nothing_is_packed() -> None:
    component = OpenIGTLink(OpenIGTLinkParameters(port=0))
    (timer,), (row,) = component.timers, component.ports
    assert list(timer.handler(AT)) == [Send(LINK, (b"",))]
    for listeners, level, text in (
        (Listeners(0), Level.OK, "0 clients"),
        (Listeners(1, ("header version 9, 1 bytes",)), Level.WARN, "header version 9"),
    ):
        (health,) = row.handler((listeners,), AT)
        assert isinstance(health, Diagnose)
        assert health.diagnostic.level is level
        assert text in health.diagnostic.message


def test_the_port_sends_batches_and_reports_its_clients() -> None:
    arrived: list[Any] = []
    with contextlib.closing(LinkPort("127.0.0.1", 0)) as port:
        port.open(arrived.append)
        port.send((b"needle",))
        log = Log("info", f"shows the needle at 127.0.0.1, port {port.port}")
        assert arrived == [(log,), (Listeners(0),)]


# Message name, its points in mm, and the proposed target in mm or the warning.
POINTS: tuple[tuple[str, tuple[tuple[str, Any], ...], Any], ...] = (
    ("Plan", (("Target-1", (10.0, -5.0, 100.0)), ("Entry-1", (0.1, 0.2, 0.3))), (10, -5, 100)),
    ("TARGET_POINT-1", (("F-1", (10.0, -5.0, 100.0)),), (10, -5, 100)),
    ("ENTRY", (("", (0.1, 0.2, 0.3)), ("", (10.0, -5.0, 100.0))), (10, -5, 100)),
    ("TARGET", (("F-1", (0.0, 30.0, 0.0)), ("F-2", (10.0, 0.0, 100.0))), "30.0 mm from that"),
    ("Fiducials", (("F-1", (10.0, -5.0, 100.0)),), None),
    ("NeedleTarget", (("NeedleTarget_0", (10.0, -5.0, 100.0)),), None),
    ("Plan", (("target a", (1.0, 1.0, 90.0)), ("target b", (1.0, 1.0, 80.0))), "several points"),
    ("Plan", (("target", (np.nan, 0.0, 100.0)),), "no target is at"),
    ("Plan", (("entry", (0.0, np.nan, 100.0)),), "nan mm from"),
    ("target", (("a", (1e9, 0.0, 0.0)),), "no target is at"),
)


@pytest.mark.parametrize(
    ("name", "points", "expected", "version"),
    [*((*row, 1) for row in POINTS), (*POINTS[0], 2), (*POINTS[0], 3)],
)
def test_a_planners_target_is_proposed(name: str, points: Any, expected: Any, version: int) -> None:
    body = b"".join(point_body(label, *at) for label, at in points)
    if version == 2:
        # An extended header with one metadata pair.
        head = struct.pack(">HHII", 12, 10, 4, 7)
        body = head + body + struct.pack(">HHHI", 1, 1, 3, 3) + b"kval"
    if version == 3:
        body = struct.pack(">HHII", 12, 0, 0, 7) + body
    (message,) = LinkStream().split(link_message("POINT", name, 1.0, body, version))
    component = OpenIGTLink(OpenIGTLinkParameters(port=0))
    actions = list(component.ports[0].handler((message,), AT))
    health = actions.pop()
    assert isinstance(health, Diagnose)
    if isinstance(expected, str):
        (log,) = actions
        assert isinstance(log, Log)
        assert expected in log.text
        assert health.diagnostic.level is Level.WARN
    else:
        assert health.diagnostic.level is Level.OK
        found = [a.message for a in actions if isinstance(a, Publish)]
        assert len(found) == len(actions) == (expected is not None)
        for point in found:
            assert (point.frame_id, point.stamp_ns) == ("rig", AT.stamp_ns)
            assert np.array(point.position) * 1e3 == pytest.approx(expected, rel=1e-6)


def test_a_damaged_point_is_a_warning() -> None:
    component = OpenIGTLink(OpenIGTLinkParameters(port=0))
    (port,) = component.ports
    extended = struct.pack(">HHII", 12, 0, 0, 0) + bytes(135)
    for version, body in ((1, b"short"), (2, b"short"), (2, extended)):
        actions = port.handler((LinkMessage(version, "POINT", "T", 0.0, body),), AT)
        assert [type(action) for action in actions] == [Log, Diagnose]
    assert not list(port.handler((LinkMessage(1, "TRANSFORM", "target", 0.0, b""),), AT))


def point_body(name: str, x: float, y: float, z: float) -> bytes:
    """Return a point as defined in http://openigtlink.org/protocols/v2_point.html."""
    text = (name.encode(), b"group", 255, 0, 0, 255, x, y, z, 1.0, b"owner")
    return struct.pack(">64s32s4B4f20s", *text)


def test_missing_pyigtl_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert executable.main() == 2
    assert "pyigtl is not installed: see docs/viewers.md" in capsys.readouterr().err
