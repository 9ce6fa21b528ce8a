"""openigtlink: what it packs with pyigtl, which is an extra and played here, and what it tells."""

from __future__ import annotations

import contextlib
import json
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
from needle_core.component import Diagnose, Log, Moment, Send
from needle_core.diagnostics import Diagnostic, Level
from needle_core.status_messages import ControllerStatus

TIP = (0.001, 0.002, 0.04)
TURN = Rotation.from_euler("xyz", (0.1, 0.2, 0.3))
AT = Moment(0.0, 7_000_000_000)
Said = dict[str, tuple[Any, float]]


class Played:
    """A message of pyigtl's: its content, time and device name; of points, their names, too."""

    def __init__(self, content: Any, *rest: Any, **named: Any) -> None:
        time, name = named.values() if named else rest
        self._said = [name, np.asarray(content).tolist(), time]

    def pack(self) -> bytes:
        return json.dumps(self._said).encode() + b"\n"


@pytest.fixture
def component(monkeypatch: pytest.MonkeyPatch) -> OpenIGTLink:
    """The component, whom somebody listens to."""
    kinds = dict.fromkeys(("StringMessage", "TransformMessage", "PointMessage"), Played)
    played: Any = SimpleNamespace(**kinds)
    monkeypatch.setitem(sys.modules, "pyigtl", SimpleNamespace(messages=played))
    monkeypatch.setitem(sys.modules, "pyigtl.messages", played)
    one = OpenIGTLink(OpenIGTLinkParameters(port=0))
    list(one.ports[0].handler((Listeners(1, 0),), AT))
    return one


def says(component: OpenIGTLink) -> Said:
    (action,) = component.timers[0].handler(AT)
    assert isinstance(action, Send)
    assert action.port == LINK
    lines = b"".join(action.batch).decode().splitlines()
    return {name: (content, time) for name, content, time in map(json.loads, lines)}


def hear(component: OpenIGTLink, topic: str, message: Any) -> None:
    (row,) = (row for row in component.inputs if row.topic == topic)
    list(row.handler(message, AT))


def pose(stamp_ns: int, sigma: float = 1e-4) -> m.PoseWithCovariance:
    x, y, z, w = TURN.as_quat().tolist()
    covariance = tuple(np.diag(np.full(6, sigma**2)).ravel().tolist())
    return m.PoseWithCovariance(stamp_ns, "rig", TIP, (x, y, z, w), covariance)


def test_messages_are_in_mm(component: OpenIGTLink) -> None:
    assert says(component) == {"NeedleStatus": ("no needle data received", 7.0)}
    status = ControllerStatus(target_offset_m=0.003, target_point_m=(0.01, 0.0, 0.1))
    hear(component, "needle/controller_status", status)
    hear(component, "joint_states", m.JointState(1, ("insertion_joint",), (0.04,)))
    hear(component, "needle/tip_pose", pose(5_250_000_000))
    # In the frame of the plane, 3 mm beside.
    hear(component, "needle/estimate", pose(5_250_000_000))
    said = says(component)
    assert said["NeedleStatus"][0] == "tip found"
    plane, time = said["TargetPlaneToRig"]
    np.testing.assert_allclose(np.array(plane)[:3, 3], [3.0, 0.0, 0.0])
    assert time == pytest.approx(7.0)
    (target,) = said["NeedleTarget"][0]
    assert target == pytest.approx([10.0, 0.0, 100.0])
    tip, time = said["NeedleTipToRig"]
    np.testing.assert_allclose(np.array(tip)[:3, 3], np.array(TIP) * 1e3, rtol=1e-6)
    np.testing.assert_allclose(np.array(tip)[:3, :3], TURN.as_matrix(), atol=1e-6)
    assert time == pytest.approx(5.25)
    shaft = said["NeedleShaft"][0]
    assert (shaft[0], shaft[-1]) == ([0.0] * 3, pytest.approx(np.array(TIP) * 1e3))
    estimate = np.array(said["NeedleEstimateToRig"][0])
    np.testing.assert_allclose(estimate[:3, 3], [4.0, 2.0, 40.0], rtol=1e-6)
    # A tip that is not seen any longer is not shown.
    for unseen in (
        pose(2_000_000_000, np.inf),
        m.PoseWithCovariance(2, "rig", TIP, (0.0,) * 4, (0.0,) * 36),
    ):
        hear(component, "needle/tip_pose", unseen)
        said = says(component)
        assert said["NeedleStatus"][0] == "no tip found"
        assert not said.keys() & {"NeedleTipToRig", "NeedleShaft"}


def test_the_port_reports_clients_and_without_any_nothing_is_packed() -> None:
    component = OpenIGTLink(OpenIGTLinkParameters(port=0))
    (timer,), (row,) = component.timers, component.ports
    assert list(timer.handler(AT)) == [Send(LINK, (b"",))]
    keys = {"listeners": "0", "turned away": "2"}
    told = Diagnose("listeners", Diagnostic(Level.OK, "nobody listens", keys))
    assert list(row.handler((Listeners(0, 2),), AT)) == [told]
    arrived: list[Any] = []
    with contextlib.closing(LinkPort(component.settings)) as port:
        port.open(arrived.append)
        port.send((b"needle",))
        log = Log("info", f"shows the needle at 127.0.0.1, port {port.server.port}")
        assert arrived == [(log,), (Listeners(0, 0),)]


def test_missing_pyigtl_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert executable.main() == 2
    assert "pyigtl is not installed; docs/viewers.md" in capsys.readouterr().err
