"""Tips accepted by the component, and the link to PLUS byte by byte."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from needle_core import messages as m
from needle_core.component import Diagnose, Moment, Peers, PortChange, Publish
from needle_core.openigtlink import LinkMessage, LinkStream, checksum
from needle_tracker.optics.calibration import pose_matrix
from needle_tracker.tracked.registration import Registration
from needle_tracker.tracked_tip import TrackedTip, TrackedTipParameters
from plus_messages import message, transform_message

TURN = Rotation.from_euler("xyz", (2.0, -0.4, 1.1))
PLACE = np.array([0.21, -0.33, 0.28])
REGISTRATION = Registration(
    T_rig_tracker=pose_matrix(TURN.as_matrix(), PLACE),
    centroid=np.zeros(3),
    covariance=np.diag([1e-8] * 3 + [1e-4] * 3),
    tip_offset=np.array([0.0, 0.0, 0.01]),
    sensor_std=0.3e-3,
)
NOW = 1_700_000_000


def sensor(depth: float, heading: Rotation, seed: int) -> np.ndarray:
    """Return the pose in the tracker's frame [m] of a sensor 10 mm behind a tip on the z axis."""
    noise = np.random.default_rng(seed).normal(0.0, 0.1e-3, 3)
    pose = np.eye(4)
    pose[:3, :3] = (TURN.inv() * heading).as_matrix()
    tip = np.array([0.0, 0.0, depth]) - heading.apply([0, 0, 0.01])
    pose[:3, 3] = TURN.inv().apply(tip - PLACE) + noise
    return pose


class Scene:
    """The component at rest at a depth, and its clock."""

    def __init__(self, depth: float = 0.02, **settings: Any) -> None:
        self.component = TrackedTip(TrackedTipParameters(**settings), REGISTRATION)
        self.now, self.depth, self.has_joints = float(NOW), depth, True
        self.topics = {row.topic: row for row in self.component.inputs}

    def at(self) -> Moment:
        return Moment(self.now, round(self.now * 1e9))

    def joints(self, insertion: float) -> None:
        state = m.JointState(self.at().stamp_ns, (m.INSERTION_JOINT,), (insertion,))
        list(self.topics["joint_states"].handler(state, self.at()))

    def send(self, seed: int, late: float = 0.0) -> list[Any]:
        """Send a transform by the source of the settings; return the actions."""
        self.now += 0.05
        if self.has_joints:
            self.joints(self.depth)
        pose = sensor(self.depth, Rotation.identity(), seed)
        stamp = self.now - late
        for kind, topic in (("pose", "tracker/pose"), ("transform", "tracker/transform")):
            if self.component.settings.source == kind:
                parts = (
                    tuple(pose[:3, 3].tolist()),
                    tuple(Rotation.from_matrix(pose[:3, :3]).as_quat()),
                )
                ros = (
                    m.Pose(round(stamp * 1e9), "aurora", *parts)
                    if kind == "pose"
                    else m.Transform(round(stamp * 1e9), "aurora", "needle", *parts)
                )
                return list(self.topics[topic].handler(ros, self.at()))
        pose[:3, 3] *= 1e3
        return self.receive(transform_message(pose, stamp))

    def receive(self, data: bytes) -> list[Any]:
        return list(self.component.ports[0].handler((data,), self.at()))

    def until_steady(self) -> list[Any]:
        return [self.send(seed) for seed in range(6)][-1]


def published(actions: list[Any]) -> dict[str, Any]:
    return {a.topic: a.message for a in actions if isinstance(a, Publish)}


def fault(actions: list[Any]) -> str:
    assert not published(actions)
    return next(a.diagnostic.message for a in actions if isinstance(a, Diagnose))


@pytest.mark.parametrize("source", ["openigtlink_client", "pose", "transform"])
def test_every_source_gives_the_tip_and_its_covariance(source: str) -> None:
    unit = "mm" if source.startswith("open") else "m"
    messages = published(Scene(source=source, unit=unit).until_steady())
    tip, pose = messages["needle/tip"], messages["needle/tip_pose"]
    assert tip == m.Point(pose.stamp_ns, "rig", pose.position)
    np.testing.assert_allclose(tip.position, [0.0, 0.0, 0.02], atol=0.5e-3)
    assert tip.stamp_ns == pytest.approx((NOW + 0.3) * 1e9, abs=1e3)
    covariance = np.reshape(pose.covariance, (6, 6))
    # The sensor, 0.01 rad at 10 mm, the registration, and its rotation at 20 mm.
    across = 0.3e-3**2 + 1e-4**2 + 1e-8
    np.testing.assert_allclose(
        np.diag(covariance)[:3], [across + 1e-4 * 0.02**2] * 2 + [across], rtol=0.05
    )
    np.testing.assert_allclose(np.diag(covariance)[3:5], 1e-4 + 1e-4, rtol=0.01)


def test_latency_moves_the_stamp_back_and_widens_the_covariance_along_the_needle() -> None:
    scene, still = Scene(latency=0.1, latency_std=0.05), Scene(latency=0.1, latency_std=0.05)
    at_rest = published(still.until_steady())["needle/tip_pose"]
    for seed in range(8):
        scene.depth += 0.05 * 4e-3
        moving: Any = published(scene.send(seed)).get("needle/tip_pose")
    assert at_rest.stamp_ns == pytest.approx((NOW + 0.2) * 1e9, abs=1e3)
    wider = np.diag(np.reshape(moving.covariance, (6, 6)) - np.reshape(at_rest.covariance, (6, 6)))
    assert wider[2] == pytest.approx((0.05 * 4e-3) ** 2, rel=0.1)
    # Across the needle, the rotation of the registration counts at another depth.
    assert abs(wider[0]) < 0.2 * wider[2]


def test_without_a_heading_axis_the_heading_is_unknown() -> None:
    pose = published(Scene(heading_axis="none").until_steady())["needle/tip_pose"]
    assert np.diag(np.reshape(pose.covariance, (6, 6)))[3:] == pytest.approx([np.pi**2] * 3)


def test_repeats_joints_quaternions_and_other_sources_are_named() -> None:
    scene = Scene()
    scene.until_steady()
    assert fault(scene.send(9, late=0.06)) == "no tip: not_newer"
    assert published(scene.send(10))
    scene.has_joints = False
    scene.now += 1.0
    assert fault(scene.send(11)) == "no tip: no_joint_states"
    topic = Scene(source="pose", unit="m")
    (row,) = (row for row in topic.component.inputs if row.topic == "tracker/pose")
    empty = m.Pose(NOW * 10**9, "aurora", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    assert fault(list(row.handler(empty, topic.at()))) == "no tip: not_a_rotation"
    scene = Scene()
    scene.until_steady()
    list(
        scene.component.on_peers(
            Peers({"needle/tip": ("stereo_tracker", "tracked_tip")}), scene.at()
        )
    )
    assert fault(scene.send(12)) == "no tip: two_sources"
    list(scene.component.on_peers(Peers({"needle/tip": ("tracked_tip",)}), scene.at()))
    assert published(scene.send(13))


def test_arrival_replaces_the_stamp_of_a_wrong_clock() -> None:
    scene = Scene(stamp_on_arrival=True, latency=0.1)
    actions = [scene.send(seed, late=3600.0) for seed in range(6)][-1]
    assert published(actions)["needle/tip"].stamp_ns == pytest.approx((NOW + 0.2) * 1e9, abs=1e3)


def test_silence_names_the_lost_connection() -> None:
    scene = Scene()
    (port,) = scene.component.ports
    list(port.on_change(PortChange("refused"), scene.at()))
    actions = list(scene.component.timers[0].handler(scene.at()))
    assert fault(actions) == "no connection: refused"


# ---- bytes -----------------------------------------------------------------------------------


def test_checksum_is_that_of_the_standard() -> None:
    assert checksum(b"123456789") == 0x6C40DF5F0B497347


@pytest.mark.parametrize("garbage", [1, 58, 59, 66])
def test_a_stream_in_pieces_among_other_messages(garbage: int) -> None:
    """Garbage and a large image before a transform do not lose it; each is reported once."""
    pose = sensor(0.02, Rotation.identity(), 1)
    wanted = [transform_message(pose, NOW + k, status="OK" if k % 2 else "") for k in range(4)]
    status = message("STATUS", "Plus", NOW, bytes(30))
    broken = bytearray(transform_message(pose, NOW))
    broken[42:50] = (1 << 40).to_bytes(8, "big")
    data = wanted[0] + status + b"\7" * garbage + wanted[1] + bytes(broken) + wanted[2] + wanted[3]
    stream, problems = LinkStream("TRANSFORM"), set()
    received: list[LinkMessage] = []
    for k in range(0, len(data), 7):
        received += stream.split(data[k : k + 7])
        problems.add(stream.problem.partition(":")[0])
    found = [each for each in received if each.kind == "TRANSFORM"]
    assert [each.name for each in received if each not in found] == ["Plus"]
    assert [t.stamp for t in found] == pytest.approx([NOW + k for k in range(4)], abs=1e-3)
    assert [t.transform()[1] for t in found] == ["", "OK", "", "OK"]
    assert problems == {"", "unreadable header"}
    np.testing.assert_allclose(found[0].transform()[0], pose, atol=1e-7)
